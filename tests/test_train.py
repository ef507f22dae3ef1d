"""The command: bad input is one line and status 2, never a traceback."""

from __future__ import annotations

import dataclasses
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from dcc_jax import config, options, tasks
from dcc_jax.training import loop

# The package shows the function of that name; these tests want the module.
train = importlib.import_module("dcc_jax.train")

SMOKE = ["--task", "push", "--preset", "smoke"]


def _said(capsys: pytest.CaptureFixture[str], argv: list[str]) -> str:
    assert train.main(argv) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("argv", "parts"),
    [
        ([], ["--task is required"]),
        (["--task", "fly", "--preset", "smoke"], ["task must be", "push", "'fly'"]),
        ([*SMOKE, "--bogus", "3"], ["--bogus"]),
        (["--task", "push", "--preset", "big"], ["smoke, cpu, gpu, paper", "'big'"]),
        ([*SMOKE, "--ppo.learning-rate", "fast"], ["learning-rate", "fast"]),
        ([*SMOKE, "--train.num-envs", "0"], ["num_envs must be 1 or more", "0"]),
        ([*SMOKE, "--env.clips", "/none/a.npz"], ["/none/a.npz"]),
        ([*SMOKE, "--env.clips", __file__], [__file__, "not a motion", ".bvh"]),
        ([*SMOKE, "--resume"], ["--resume needs --run-dir"]),
        ([*SMOKE, "--ppo.minibatch-size", "100"], ["ppo.minibatch_size", "100"]),
    ],
)
def test_bad_argument_is_one_line_and_status_two(argv, parts, capsys, tmp_path):
    where = [] if "--resume" in argv else ["--run-dir", str(tmp_path / "run")]
    line = _said(capsys, [*argv, *where])
    for part in parts:
        assert part in line
    assert not (tmp_path / "run").exists()


def test_environments_that_devices_cannot_share_are_one_line(capsys, tmp_path):
    if len(jax.devices()) == 1:
        pytest.skip("one device shares any number of environments")
    argv = [*SMOKE, "--train.num-envs", "17", "--run-dir", str(tmp_path / "run")]
    assert "num_envs must be a multiple of the" in _said(capsys, argv)


def test_directory_that_is_not_a_run_is_one_line(capsys, tmp_path):
    argv = ["--resume", "--run-dir", str(tmp_path)]
    assert "is not a run directory" in _said(capsys, argv)


def test_run_directory_in_use_is_not_overwritten(capsys, tmp_path):
    (tmp_path / "precious.txt").write_text("keep")
    line = _said(capsys, [*SMOKE, "--run-dir", str(tmp_path)])
    assert "is not empty" in line
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_run_directory_that_cannot_be_made_is_one_line(capsys, tmp_path):
    (tmp_path / "file").write_text("no folder")
    line = _said(capsys, [*SMOKE, "--run-dir", str(tmp_path / "file" / "run")])
    assert "file/run cannot be written" in line
    assert "--run-dir DIR names another place" in line


def test_resumed_run_cannot_change_its_networks(capsys, tmp_path):
    (tmp_path / "config.json").write_text(
        config.to_json(config.make_config("push", "smoke"))
    )
    argv = ["--resume", "--run-dir", str(tmp_path), "--ppo.hidden", "64", "64"]
    line = _said(capsys, argv)
    assert "ppo.hidden is (32, 32)" in line and "(64, 64)" in line


def test_policy_without_a_checkpoint_is_not_resumed_and_not_lost(capsys, tmp_path):
    (tmp_path / "config.json").write_text(
        config.to_json(config.make_config("push", "smoke"))
    )
    (tmp_path / "policy.npz").write_bytes(b"precious")
    line = _said(capsys, ["--resume", "--run-dir", str(tmp_path)])
    assert "holds a policy and no checkpoint" in line
    assert f"--train.start-from {tmp_path}" in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "policy.npz"]
    assert (tmp_path / "policy.npz").read_bytes() == b"precious"


def test_resumed_run_may_train_longer(tmp_path):
    made = config.make_config("push", "smoke")
    (tmp_path / "config.json").write_text(config.to_json(made))
    said = options.parse(
        ["--resume", "--run-dir", str(tmp_path), "--train.total-tuples", "9000"]
    )
    assert said.resume and said.run_dir == tmp_path
    longer = dataclasses.replace(made.train, total_tuples=9000)
    assert said.config == dataclasses.replace(made, train=longer)


def test_options_override_the_preset():
    said = options.parse(
        [*SMOKE, "--seed", "7", "--ppo.learning-rate", "3e-4", "--env.alpha", "0.04"]
    )
    made = config.make_config("push", "smoke")
    assert said.config.seed == 7
    assert said.config.ppo == dataclasses.replace(made.ppo, learning_rate=3e-4)
    assert said.config.env == dataclasses.replace(made.env, alpha=0.04)


def _names(section: object, prefix: str = "--") -> Iterator[str]:
    """The flags of a configuration: every entry of every section."""
    for entry in dataclasses.fields(section):
        name, value = entry.name.replace("_", "-"), getattr(section, entry.name)
        if dataclasses.is_dataclass(value):
            yield from _names(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def _help(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    assert train.main([*argv, "--help"]) == 0
    return " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())


def test_help_has_every_entry_of_every_section(capsys):
    text = _help(capsys, "--task", "push")
    names = list(_names(config.make_config("push")))
    assert {name.partition(".")[0] for name in names} >= {"--env", "--ppo", "--train"}
    for name in (*names, "--run-dir", "--resume"):
        assert f" {name} " in text.replace(",", " "), name


def test_help_cites_sources_and_shows_the_defaults_of_the_preset(capsys):
    paper, cpu = (_help(capsys, "--preset", name) for name in ("paper", "cpu"))
    for source in ("Sec. 5.1", "Schulman 2017"):
        assert source in paper
    default = r"--ppo\.value-learning-rate FLOAT .*?\(default: (\S+)\)"
    rates = [re.search(default, text) for text in (paper, cpu)]
    made = [config.make_config("trampoline", name) for name in ("paper", "cpu")]
    assert [rate and float(rate[1]) for rate in rates] == [
        one.ppo.value_learning_rate for one in made
    ]
    assert made[0].ppo.value_learning_rate != made[1].ppo.value_learning_rate


def test_help_names_the_tasks_and_presets_that_are_allowed(capsys):
    text = _help(capsys)
    for flag, names in (("task", tasks.TASKS), ("preset", config.PRESETS)):
        (said,) = re.findall(rf" --{flag} ([^(]*)", text)
        for name in names:
            assert re.search(rf"\b{name}\b", said), name


def test_command_leaves_with_status_two():
    done = subprocess.run(
        [sys.executable, "-m", "dcc_jax.train", "--task", "push", "--bogus", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "Unrecognized options: --bogus" in done.stderr
    assert "Traceback" not in done.stderr


def test_failed_run_is_one_line_and_status_one(monkeypatch, capsys, tmp_path):
    def fail(run: loop.Run) -> None:
        raise loop.RunError("disk full")

    monkeypatch.setattr(loop, "execute", fail)
    monkeypatch.setattr(loop, "make_environment", lambda wanted: None)
    assert train.main([*SMOKE, "--run-dir", str(tmp_path / "run")]) == 1
    assert capsys.readouterr().err == "dcc_jax.train: disk full\n"


def test_error_nobody_foresaw_is_one_line_with_details_in_a_file(
    monkeypatch, capsys, tmp_path
):
    def fail(run: loop.Run) -> None:
        raise ZeroDivisionError("one over zero\nand more")

    monkeypatch.setattr(loop, "execute", fail)
    monkeypatch.setattr(loop, "make_environment", lambda wanted: None)
    run_dir: Path = tmp_path / "run"
    assert train.main([*SMOKE, "--run-dir", str(run_dir)]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "ZeroDivisionError: one over zero" in lines[0]
    assert "and more" in (run_dir / "error.log").read_text()
