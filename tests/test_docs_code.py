"""The Python and the commands in README and docs run as they are printed.

Training, evaluating and filming are stood in for: a call has to fit the signature of
what it names, and gets a result of the real class with one entry of everything.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import dcc_jax
from dcc_jax.__main__ import main
from dcc_jax.character import asset_path
from dcc_jax.config import Config, make_config, to_json
from dcc_jax.evaluate import measures
from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.compare import Condition
from dcc_jax.evaluate.report import Report
from dcc_jax.play.runs import find_run
from dcc_jax.training.loop import TrainResult
from dcc_jax.training.sweep import SweepResult
from still import Still
from tools import config_reference

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:dcc-jax|make) [^`\n]+)`")
# What a page says of a result: `report = dcc_jax.evaluate(...)  # .rows, .summary`.
ACCESS = re.compile(r"= dcc_jax\.(\w+)\(.*\)  # (\.\w+(?:, \.\w+)*)$", re.MULTILINE)
FINAL_ANGLE = "task/angle/final"  # of the door, as an example of a task's own numbers
RESULTS = {"train": TrainResult, "evaluate": Report, "sweep": SweepResult}
TASK_PAGE = ROOT / "docs" / "tasks.md"


def python(page: Path) -> str:
    """The Python of a page, every line where it is in the page."""
    text = page.read_text()
    lines = [""] * len(text.splitlines())
    for block in FENCE.finditer(text):
        if block[1] == "python":
            first = text[: block.start(2)].count("\n")
            code = block[2].splitlines()
            lines[first : first + len(code)] = code
    return "\n".join(lines) + "\n"


def commands(page: Path) -> list[str]:
    """The lines of a page's blocks without a language, and commands in its text."""
    text = page.read_text()
    blocks = [block[2] for block in FENCE.finditer(text) if not block[1]]
    lines = [line for block in blocks for line in block.splitlines() if line]
    return lines + INLINE.findall(FENCE.sub("", text))


WITH_PYTHON = [page for page in PAGES if python(page).strip()]
COMMANDS = sorted({command for page in PAGES for command in commands(page)})


def beginning_with(program: str) -> list[str]:
    return [c for c in COMMANDS if c.startswith(program)]


def by_path(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def stood_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of everything that takes minutes."""
    one = Interval(0.5, 0.4, 0.6)
    row: dict[str, Any] = dict.fromkeys([*measures.METRICS, FINAL_ANGLE], 0.5)
    report = Report(
        **emptied(Report)
        | {
            "conditions": [Condition("run", 0.0)],
            "summary": [dict.fromkeys(measures.METRICS, one)],
            "rows": [row],
        }
    )
    results = {
        "train": TrainResult(
            params=None,  # pyright: ignore[reportArgumentType]
            metrics=[{"episode/length": 1.0}],
            run_dir=Path("runs/mine"),
            finished=True,
        ),
        "evaluate": report,
        "sweep": SweepResult(**emptied(SweepResult) | {"rows": [row]}),
        "render": None,
    }
    for name, result in results.items():
        real = getattr(dcc_jax, name)
        monkeypatch.setattr(dcc_jax, name, checked(real, result))
    monkeypatch.setattr("dcc_jax.play.program.Program", Still)
    for name in ("ray", "submitit"):  # which the project does without
        monkeypatch.setitem(sys.modules, name, ModuleType(name))


def emptied(kind: type) -> dict[str, Any]:
    """No value for each field of a result, whatever fields it has."""
    return {name: [] for name in inspect.signature(kind).parameters}


def checked(real: Callable[..., Any], result: Any) -> Callable[..., Any]:
    """A function that takes what `real` takes, checks what is cheap, and returns."""

    def call(*arguments: Any, **named: Any) -> Any:
        bound = inspect.signature(real).bind(*arguments, **named).arguments
        if "config" in bound:
            assert isinstance(bound["config"], Config)
        elif isinstance(bound["run_dir"], str) and "/" not in bound["run_dir"]:
            changes = {f"task.{k}": v for k, v in bound.get("task", {}).items()}
            find_run(bound["run_dir"]).config.with_(changes)
        return result

    return call


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with what the pages suppose to be there."""
    forget_registered(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copy(asset_path("character.xml"), "robot.xml")
    Path("rubber_band.py").write_text(first_python(TASK_PAGE))
    monkeypatch.delitem(sys.modules, "rubber_band", raising=False)
    tasks_of_runs = {"push": "push", "a": "push", "b": "push"}
    for name, task in (tasks_of_runs | {"band": "rubber_band:RubberBand"}).items():
        run_dir = tmp_path / "runs" / name
        run_dir.mkdir(parents=True)
        (run_dir / "config.json").write_text(to_json(make_config(task)))
    forget_registered(monkeypatch)
    return tmp_path


def forget_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks that a page registers, or names, are not there afterwards."""
    monkeypatch.setattr("dcc_jax.tasks.registry._REGISTERED", {})


def first_python(page: Path) -> str:
    return next(b[2] for b in FENCE.finditer(page.read_text()) if b[1] == "python")


@pytest.mark.parametrize("page", WITH_PYTHON, ids=by_path)
def test_python_of_a_page_runs(page, workplace, stood_in):
    code = workplace / f"{page.stem}_page.py"
    code.write_text(python(page))
    runpy.run_path(str(code), run_name=code.stem)


def test_what_a_page_says_of_a_result_is_there():
    said = [found for page in PAGES for found in ACCESS.findall(python(page))]
    assert {name for name, _ in said} >= {"train", "evaluate"}
    for name, attributes in said:
        there = {entry.name for entry in dataclasses.fields(RESULTS[name])}
        assert set(attributes.replace(".", "").split(", ")) <= there


def test_a_call_with_an_argument_that_is_none_is_found(stood_in):
    with pytest.raises(TypeError, match="episode_count"):
        dcc_jax.evaluate("push", **{"episode_count": 3})
    with pytest.raises(ValueError, match="breadth"):
        dcc_jax.evaluate("door", **{"task": {"breadth": 1.5}})


def test_a_pages_lines_are_where_the_page_has_them():
    numbered = python(ROOT / "README.md").splitlines()
    page = (ROOT / "README.md").read_text().splitlines()
    assert all(
        ours in ("", theirs) for ours, theirs in zip(numbered, page, strict=True)
    )


def test_pages_have_commands_of_every_kind():
    kinds = {command.split()[1] for command in beginning_with("dcc-jax ")}
    assert kinds == {"train", "evaluate", "render", "view", "motion", "curves"}
    assert (
        beginning_with("make ") and beginning_with("python ") and beginning_with("pip ")
    )


def test_every_command_of_the_pages_is_of_a_kind_that_is_checked():
    known = ("dcc-jax ", "python ", "make ", "pip install -e ", "grep -rn")
    assert [c for c in COMMANDS if not c.startswith(known)] == []


@pytest.mark.parametrize("command", beginning_with("dcc-jax "))
def test_command_of_a_page_is_understood(command, workplace, monkeypatch, capsys):
    def read_only(program, argv, read, prepare):
        read(list(argv))
        return 0

    monkeypatch.setattr("dcc_jax.command.run", read_only)
    status = main(shlex.split(command, comments=True)[1:])
    assert status == 0, capsys.readouterr().err


@pytest.mark.parametrize("command", beginning_with("python "))
def test_program_of_a_page_exists(command):
    program = shlex.split(command, comments=True)[1:]
    if program[0] == "-m":
        assert importlib.util.find_spec(program[1]) is not None
    else:
        assert (ROOT / program[0]).is_file()


@pytest.mark.parametrize("command", beginning_with("make "))
def test_make_target_of_a_page_exists(command):
    target = command.split()[1]
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_configuration_page_is_what_the_source_says():
    assert config_reference.PAGE.read_text() == config_reference.page(), (
        "run python -m tools.config_reference"
    )
