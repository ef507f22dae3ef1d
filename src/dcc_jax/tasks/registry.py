"""Tasks by name: those of the paper, and those that others bring along."""

from __future__ import annotations

import importlib
import re
import sys
from dataclasses import MISSING, fields
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from dcc_jax.env.task import Task
from dcc_jax.tasks.backflip import Backflip
from dcc_jax.tasks.ball import Ball
from dcc_jax.tasks.chicken_fight import ChickenFight
from dcc_jax.tasks.door import Door
from dcc_jax.tasks.hand_in_hand import HandInHand
from dcc_jax.tasks.locomotion import Locomotion
from dcc_jax.tasks.push import Push
from dcc_jax.tasks.sustained_push import SustainedPush
from dcc_jax.tasks.trampoline import Trampoline

T = TypeVar("T", bound=type[Task])

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        Push,
        Locomotion,
        SustainedPush,
        Trampoline,
        Backflip,
        HandInHand,
        ChickenFight,
        Door,
        Ball,
    )
}
_REGISTERED: dict[str, type[Task]] = {}


def register_task(kind: T) -> T:
    """Makes a task of one's own known under its `name`; also serves as a decorator.

    Args:
        kind: a frozen dataclass that derives from `Task`, with a name of its own and a
            default for every parameter. Registering it anew replaces it.

    Raises:
        ValueError: it is no such class, or the name is taken.
    """
    _check(kind)
    known = (TASKS | _REGISTERED).get(kind.name, kind)
    if _address(known) != _address(kind):
        raise ValueError(
            f"the name {kind.name!r} of {_address(kind)} is taken by {_address(known)}"
        )
    if kind.name not in TASKS:
        _REGISTERED[kind.name] = kind
    return kind


def find_task(name: str) -> type[Task]:
    """The task of a name, or of an address `package.module:Name`.

    A module is found where Python finds it, and in the working directory.

    Raises:
        ValueError: there is none; the message lists those that have a name.
    """
    if ":" in name:
        return register_task(_imported(name))
    known = TASKS | _REGISTERED
    if name not in known:
        raise ValueError(
            f"task must be one of {', '.join(known)}, or package.module:Name, "
            f"got {name!r}"
        )
    return known[name]


def task_name(task: Task) -> str:
    """What `find_task` finds its class by, in another process too where that can be."""
    kind = type(task)
    if kind in TASKS.values() or not _has_address(kind):
        return kind.name
    return _address(kind)


def make_task(task: str | Task | type[Task]) -> Task:
    """A task with its defaults; one that is made already is left as it is.

    Raises:
        ValueError: there is none of that name, or the class is no proper task.
    """
    if isinstance(task, Task):
        register_task(type(task))
        return task
    return (find_task(task) if isinstance(task, str) else register_task(task))()


def _check(kind: Any) -> None:
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ValueError(f"a task must be a class that derives from Task, got {kind!r}")
    # A subclass inherits the mark of its parent without having its fields noted.
    if "__dataclass_params__" not in vars(kind):
        raise ValueError(
            f"{_address(kind)} must be a frozen dataclass: put @dataclass(frozen=True) "
            "above it"
        )
    if not re.fullmatch(r"[\w.-]+", kind.name):
        raise ValueError(
            f"{_address(kind)} needs a name of letters, digits and dashes: "
            f"`name: ClassVar[str]`, got {kind.name!r}"
        )
    for entry in fields(kind):
        if entry.default is MISSING and entry.default_factory is MISSING:
            raise ValueError(f"{_address(kind)}.{entry.name} needs a default")


def _imported(address: str) -> type[Task]:
    module, _, name = address.partition(":")
    if not (name.isidentifier() and all(p.isidentifier() for p in module.split("."))):
        raise ValueError(f"task must be package.module:Name, got {address!r}")
    try:
        return getattr(_module(module), name)
    except AttributeError:
        raise ValueError(f"task {address}: {module} has no {name}") from None
    except ImportError as error:
        raise ValueError(f"task {address}: {error}") from error


def _module(name: str) -> ModuleType:
    """Raises ImportError whatever goes wrong in the module."""
    # As `python -m` has it; the script of a package has not.
    sys.path.append(str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise ImportError(f"importing {name} fails: {error}") from error
        raise ImportError(f"there is no module {name}") from None
    except Exception as error:
        raise ImportError(
            f"importing {name} fails: {type(error).__name__}: {error}"
        ) from error
    finally:
        sys.path.pop()


def _has_address(kind: type[Task]) -> bool:
    return kind.__module__ != "__main__" and kind.__qualname__.isidentifier()


def _address(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"
