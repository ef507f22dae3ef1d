"""Every command alike: help, complaints of one line, statuses, readers that leave."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import pytest
from tyro.conf import Positional

from dcc_jax import __main__ as main
from dcc_jax import command
from dcc_jax.evaluate import __main__ as evaluate
from dcc_jax.motion import __main__ as motion
from dcc_jax.play import overrides

ROOT = Path(__file__).resolve().parents[1]
CLIP = ROOT / "assets" / "motions" / "walk.npz"
COMMANDS = [
    *((name,) for name in main.COMMANDS if name != "motion"),
    *(("motion", name) for name in motion.COMMANDS),
]
each_command = pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
# Enough for the rest of the command line to count; nothing of it is carried out.
ENOUGH = {
    "train": ["--task", "push", "--preset", "smoke"],
    "evaluate": ["push"],
    "render": ["push"],
    "view": ["push"],
    "curves": ["/none/here"],
    "import": ["/none/here.bvh", "--out", "/none/here.npz"],
    "inspect": ["/none/here.npz"],
    "export": ["push", "--out", "/none/here.bvh"],
}


def complaint(capsys: pytest.CaptureFixture[str], words, *others: str) -> str:
    """The one line with which a command refuses its arguments."""
    assert main.main([*words, *others]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.startswith(".".join(("dcc_jax", *words)) + ": ")
    return said.err


@each_command
def test_help_of_a_command_is_its_usage_and_status_0(words, capsys):
    assert main.main([*words, "--help"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"usage: dcc-jax {' '.join(words)} ")
    assert "Exit status: 0 done" in said.out and said.err == ""


@each_command
def test_every_option_in_the_help_is_explained_and_says_its_default(words, capsys):
    main.main([*words, "--help"])
    text = re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out)
    entries = re.split(r"\n  (?=\S)", text)
    entries = [e for e in entries if re.match("--[a-z]|SRC|RUN_DIR|CLIP", e)]
    assert len(entries) > 1
    for entry in entries:
        said = " ".join(entry.split())
        assert re.search(r"[a-zA-Z.;,]{3} .*\((default:.*|required.*)\)", said), entry


@each_command
def test_unknown_flag_is_one_line(words, capsys):
    line = complaint(capsys, words, *ENOUGH[words[-1]], "--bogus")
    assert "--bogus; see --help" in line


@pytest.mark.parametrize("words", [c for c in COMMANDS if c != ("view",)], ids=" ".join)
def test_missing_argument_is_one_line(words, capsys):
    line = complaint(capsys, words)
    missing = {"train": "--task", "import": "--out", "inspect": "CLIP.npz"}
    assert missing.get(words[-1], "RUN_DIR") in line and "see --help" in line


@pytest.mark.parametrize(
    ("words", "flag", "value"),
    [
        (("train",), "--seed", "many"),
        (("train",), "--ppo.hidden", "64x64"),
        (("evaluate",), "--episodes", "many"),
        (("evaluate",), "--alpha", "soft"),
        (("render",), "--seconds", "long"),
        (("motion", "import"), "--fps", "fast"),
        (("motion", "import"), "--rest-frame", "1.5"),
    ],
)
def test_value_that_cannot_be_read_is_one_line(words, flag, value, capsys):
    line = complaint(capsys, words, *ENOUGH[words[-1]], flag, value)
    assert flag in line and value in line


@each_command
def test_flag_without_its_value_is_one_line(words, capsys):
    flag = {
        "evaluate": "--seed",
        "render": "--seed",
        "inspect": "--plot",
        "train": "--seed",
    }.get(words[-1], "--out")
    assert flag in complaint(capsys, words, *ENOUGH[words[-1]], flag)


@pytest.mark.parametrize(
    ("argv", "known"), [([], main.COMMANDS), (["motion"], motion.COMMANDS)]
)
def test_without_a_command_they_are_listed(argv, known, capsys):
    assert main.main(argv) == 2
    listed = capsys.readouterr().err.splitlines()
    for name, (_, text) in known.items():
        assert sum(line.split() == [name, *text.split()] for line in listed) == 1
    assert main.main([*argv, "--help"]) == 0
    assert capsys.readouterr().out.splitlines() == listed


@pytest.mark.parametrize(
    ("argv", "known"), [(["fly"], main.COMMANDS), (["motion", "fly"], motion.COMMANDS)]
)
def test_unknown_command_is_one_line_with_those_there_are(argv, known, capsys):
    assert main.main(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'fly'" in line and line.endswith(", ".join(known))


@dataclass(frozen=True)
class Options:
    """Works on a name."""

    name: Annotated[str, Positional]
    """Of something."""


def carried_out(work, *argv: str) -> int:
    read = partial(command.parse, "dcc_jax.toy", Options)
    return command.run("dcc_jax.toy", argv or ["a"], read, lambda options: work)


def raising(error: BaseException):
    def work() -> None:
        raise error

    return work


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_status_is_that_of_the_work():
    assert carried_out(lambda: None) == 0
    assert carried_out(lambda: 2) == 2


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (command.WorkError("the disk\nis full"), "the disk is full"),
        (KeyboardInterrupt(), "interrupted"),
        (SystemExit("jax hangs"), "jax hangs"),
    ],
)
def test_work_that_fails_as_foreseen_is_its_line_and_status_1(
    error, line, capsys, temporary
):
    assert carried_out(raising(error)) == 1
    assert capsys.readouterr().err == f"dcc_jax.toy: {line}\n"
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("error", [ValueError("odd\nx = 3"), RecursionError("odd\nx")])
def test_error_nobody_foresaw_is_one_line_with_details_in_a_file(
    error, capsys, temporary
):
    assert carried_out(raising(error)) == 1
    (line,) = capsys.readouterr().err.splitlines()
    (log,) = temporary.iterdir()
    name = type(error).__name__
    assert line == f"dcc_jax.toy: {name}: odd (details in {log})"
    assert "Traceback" in log.read_text() and str(error) in log.read_text()


def test_script_that_fails_is_one_line_and_status_1(tmp_path):
    experiment = tmp_path / "bad_sum.py"
    experiment.write_text(
        "from dcc_jax import command\n"
        "def main():\n    raise ValueError('odd')\n"
        "command.script(main)\n"
    )
    env = {**os.environ, "TMPDIR": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, str(experiment)], capture_output=True, text=True, env=env
    )
    assert run.returncode == 1
    assert run.stderr.startswith("bad_sum: ValueError: odd (details in ")
    assert run.stderr.count("\n") == 1


def test_error_nobody_foresaw_in_the_arguments_ends_in_no_traceback(capsys, temporary):
    def prepare(options: Options):
        raise ZeroDivisionError("one over zero")

    read = partial(command.parse, "dcc_jax.toy", Options)
    assert command.run("dcc_jax.toy", ["a"], read, prepare) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_complaint_is_whole_in_a_narrow_terminal(capsys, monkeypatch):
    """tyro breaks what is wider than the terminal, names of files in the middle."""
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    long = "--" + "x" * 300
    assert carried_out(lambda: None, "a", long) == 2
    said = capsys.readouterr().err
    assert said == f"dcc_jax.toy: Unrecognized options: {long}; see --help\n"
    assert os.environ["COLUMNS"] == "40"


class _Closed(io.StringIO):
    """A pipe whose reader has left."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


def test_work_goes_on_when_the_reader_of_its_output_leaves(monkeypatch):
    done = []

    def work() -> None:
        print("a line")
        print("another", file=sys.stderr)
        done.append(True)

    monkeypatch.setattr("sys.stdout", _Closed())
    monkeypatch.setattr("sys.stderr", _Closed())
    assert carried_out(work) == 0 and done


def test_reader_that_leaves_sees_no_traceback():
    """As of `dcc-jax motion inspect CLIP | head -0`: the pipe closes at once."""
    argv = [sys.executable, "-u", "-m", "dcc_jax", "motion", "inspect", str(CLIP)]
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe:
        done = subprocess.run(
            argv, stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=120
        )
    assert (done.returncode, done.stderr) == (0, "")


def test_script_and_module_are_one():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"dcc-jax": "dcc_jax.__main__:script"}
    code = "from dcc_jax.__main__ import script; script()"
    for argv in (["fly"], ["motion", "inspect", str(CLIP)]):
        said = [
            subprocess.run(
                [sys.executable, *how, *argv],
                capture_output=True,
                text=True,
                timeout=120,
            )
            for how in (["-c", code], ["-m", "dcc_jax"])
        ]
        assert len({(one.returncode, one.stdout, one.stderr) for one in said}) == 1
        assert "Traceback" not in said[0].stderr


@pytest.mark.parametrize("words", [(), ("evaluate",), ("render",), ("curves",)])
def test_help_needs_no_jax(words):
    code = (
        "import sys\n"
        "from dcc_jax.__main__ import main\n"
        f"assert main({[*words, '--help']}) == 0\n"
        "sys.exit(sum(name in sys.modules for name in ('jax', 'mujoco', 'scipy')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True)
    assert done.returncode == 0, done.stderr


def read(*argv: str) -> evaluate.Options:
    return overrides.read(evaluate.PROGRAM, evaluate.Options, argv)


def test_parameters_of_the_task_are_kept_for_when_it_is_known():
    said = read("door", "push", "--task.width", "1.5", "--seed", "3", "--task.reach=1")
    assert said.run_dir == ("door", "push") and said.seed == 3
    assert said.task == ("--task.width", "1.5", "--task.reach=1")


def test_parameters_are_read_as_the_task_of_the_run_has_them():
    for name, arguments, wanted in (
        ("door", ("--task.width", "1.5", "--task.reach=1"), {"width": 1.5, "reach": 1}),
        ("push", ("--task.speed", "1", "2"), {"speed": (1.0, 2.0)}),
        ("push", (), {}),
    ):
        assert overrides.changes(evaluate.PROGRAM, name, arguments) == wanted
    # A value as it was trained counts: another run may have been trained otherwise.
    same = overrides.changes(evaluate.PROGRAM, "door", ("--task.width", "1.0"))
    assert same == {"width": 1.0}


@pytest.mark.parametrize("words", [("evaluate",), ("render",)])
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--task.width", "wide"], "--task.width: could not convert"),
        (["--task.wdth", "2"], "Unrecognized options: --task.wdth"),
        (["--task.width", "-1"], "width must be positive, got -1.0"),
        (["--task.width"], "Missing value for argument '--task.width'"),
    ],
)
def test_bad_parameter_of_the_task_is_one_line(words, arguments, part, capsys):
    assert part in complaint(capsys, words, "door", *arguments)
