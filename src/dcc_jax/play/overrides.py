"""Options `--task.width 1.5`: parameters of the task in place of those trained with."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

from tyro.conf import arg

from dcc_jax import command

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    class HasTask(DataclassInstance, Protocol):
        """Options of a command with an entry `task: TaskParameters`."""

        @property
        def task(self) -> tuple[str, ...]: ...

    T = TypeVar("T", bound=HasTask)

PREFIX = "--task."

TaskParameters = Annotated[
    tuple[str, ...],
    arg(
        name="task.NAME",
        metavar="VALUE",
        help="A parameter of the task, like --task.width 1.5 of a door; `dcc-jax train "
        "--task door --help` lists them.",
        help_behavior_hint="(default: as in training)",
    ),
]


def read(program: str, kind: type[T], arguments: Sequence[str]) -> T:
    """Reads arguments; what the task's parameters may be turns out with the run.

    Args:
        program: as of `command.parse`.
        kind: the dataclass of the options. Its entry `task` keeps the arguments that
            begin with `--task.` and their values, as they are.
        arguments: without the program's name.

    Raises:
        ValueError: one line that says what is wrong.
        SystemExit: the help was printed.
    """
    kept: list[str] = []
    others: list[str] = []
    into = others
    for word in arguments:
        if word.startswith("--"):
            into = kept if word.startswith(PREFIX) else others
        into.append(word)
    return dataclasses.replace(command.parse(program, kind, others), task=tuple(kept))


def changes(program: str, run_dir: str, arguments: Sequence[str]) -> dict[str, Any]:
    """The values of the parameters by name, as the task of a run reads them.

    Raises:
        ValueError: there is no such run or parameter, or a value is no such thing.
    """
    if not arguments:
        return {}
    from dcc_jax.play.runs import find_run

    task = find_run(run_dir).config.task
    kind = dataclasses.make_dataclass("Options", [("task", type(task))], frozen=True)
    made: Any = command.parse(program, kind, arguments, kind(task))
    flags = [word for word in arguments if word.startswith(PREFIX)]
    names = [
        flag.removeprefix(PREFIX).partition("=")[0].replace("-", "_") for flag in flags
    ]
    return {name: reduce(getattr, name.split("."), made.task) for name in names}
