"""Tasks that others bring along: registered from Python, or named by their address."""

from __future__ import annotations

import re
import sys
import textwrap
from dataclasses import dataclass
from typing import ClassVar

import pytest

import dcc_jax
from dcc_jax import config, options
from dcc_jax.env.task import Task
from dcc_jax.tasks import registry
from dcc_jax.tasks.door import Door

SOURCE = """
    from dataclasses import dataclass
    from typing import ClassVar

    from dcc_jax.env.task import Task

    @dataclass(frozen=True)
    class Band(Task):
        name: ClassVar[str] = "band"
        stiffness: float = 60.0
        \"\"\"N/m, of the band.\"\"\"

    class Plain:
        pass

    class Unmarked(Band):
        stiffness: float = 70.0

    @dataclass(frozen=True)
    class Unnamed(Task):
        width: float = 1.0

    @dataclass(frozen=True)
    class Spaced(Task):
        name: ClassVar[str] = "my task"

    @dataclass(frozen=True)
    class Wanting(Task):
        name: ClassVar[str] = "wanting"
        width: float

    @dataclass(frozen=True)
    class Taken(Task):
        name: ClassVar[str] = "door"
"""


@pytest.fixture(autouse=True)
def directory(tmp_path, monkeypatch):
    """The working directory, where two modules lie; what is registered is forgotten."""
    (tmp_path / "outside_task.py").write_text(textwrap.dedent(SOURCE))
    (tmp_path / "broken_task.py").write_text("import no_such_thing\n")
    (tmp_path / "failing_task.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTERED", {})
    yield tmp_path
    for name in ("outside_task", "broken_task", "failing_task"):
        sys.modules.pop(name, None)


def test_task_of_the_working_directory_is_found_by_its_address():
    path = list(sys.path)
    made = config.make_config("outside_task:Band")
    assert (made.task.name, made.task.stiffness) == ("band", 60.0)  # pyright: ignore
    assert sys.path == path


def test_task_from_outside_survives_json_by_its_address():
    made = config.make_config("outside_task:Band").with_({"task.stiffness": 80})
    text = config.to_json(made)
    assert '"name": "outside_task:Band"' in text
    registry._REGISTERED.clear()
    assert config.from_json(text) == made


def test_parameters_of_a_task_from_outside_are_options_of_the_command():
    said = options.parse(
        ["--task", "outside_task:Band", "--task.stiffness", "80", "--preset", "smoke"]
    )
    assert said.config.task.stiffness == 80.0  # pyright: ignore
    assert said.run_dir.name.startswith("band-")


def test_registered_task_goes_by_its_name():
    @dcc_jax.register_task
    @dataclass(frozen=True)
    class Rope(Task):
        name: ClassVar[str] = "rope"
        length: float = 2.0

    made = config.make_config("rope").with_({"task.length": 3})
    assert made.task == Rope(length=3.0)
    # A class inside a function has no address.
    assert '"name": "rope"' in config.to_json(made)
    assert config.from_json(config.to_json(made)) == made


def test_class_that_is_defined_anew_replaces_the_old_one():
    def define() -> type[Task]:
        @dataclass(frozen=True)
        class Rope(Task):
            name: ClassVar[str] = "rope"

        return Rope

    dcc_jax.register_task(define())
    newer = dcc_jax.register_task(define())
    assert registry.find_task("rope") is newer


def test_task_of_the_paper_may_be_registered_again():
    assert dcc_jax.register_task(Door) is Door
    assert "door" not in registry._REGISTERED


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("no_such_module:Band", "task no_such_module:Band: there is no module"),
        ("no.such.module:Band", "there is no module no.such.module"),
        ("outside_task:Bend", "task outside_task:Bend: outside_task has no Bend"),
        ("outside_task:", "must be package.module:Name, got 'outside_task:'"),
        (":Band", "must be package.module:Name, got ':Band'"),
        ("a:b:c", "must be package.module:Name, got 'a:b:c'"),
        ("outside_task:Plain", "a class that derives from Task"),
        ("outside_task:dataclass", "a class that derives from Task"),
        ("outside_task:Unmarked", "put @dataclass(frozen=True) above it"),
        ("outside_task:Unnamed", "outside_task:Unnamed needs a name"),
        ("outside_task:Spaced", "needs a name of letters, digits and dashes"),
        ("outside_task:Wanting", "outside_task:Wanting.width needs a default"),
        ("outside_task:Taken", "is taken by dcc_jax.tasks.door:Door"),
        ("broken_task:Band", "importing broken_task fails: No module named"),
        ("failing_task:Band", "importing failing_task fails: ZeroDivisionError"),
    ],
)
def test_address_that_leads_to_no_task_is_one_line(address, said):
    with pytest.raises(ValueError, match=re.escape(said)) as caught:
        config.make_config(address)
    assert "\n" not in str(caught.value)


def test_value_that_json_cannot_hold_is_named():
    @dataclass(frozen=True)
    class Held(Task):
        name: ClassVar[str] = "held"
        what: object = complex(1, 2)

    with pytest.raises(ValueError, match="not a complex"):
        config.to_json(config.make_config(Held))
