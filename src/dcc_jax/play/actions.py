"""What a person may have a task do: throw, bounce, bump, lead elsewhere.

A task needs nothing for it. Everything here sets numbers of the task's own state,
outside the compiled program.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dcc_jax.env.task import Task
from dcc_jax.tasks.ball import Ball
from dcc_jax.tasks.chicken_fight import ChickenFight
from dcc_jax.tasks.door import Door
from dcc_jax.tasks.hand_in_hand import HandInHand
from dcc_jax.tasks.locomotion import Locomotion
from dcc_jax.tasks.push import Push
from dcc_jax.tasks.sustained_push import SustainedPush
from dcc_jax.tasks.trampoline import Trampoline

LONG = 1e6  # s


@dataclass(frozen=True)
class Action:
    """A button, or with a range a slider."""

    name: str
    apply: Callable[[Task, Any, float | None], Any]
    """(task, its state, value) -> its state"""
    low: float | None = None
    high: float | None = None
    unit: str = ""

    @property
    def is_slider(self) -> bool:
        """Whether it takes a value."""
        return self.low is not None


@dataclass(frozen=True)
class Schedule:
    """A countdown in a task's state to what happens by itself."""

    name: str  # of the button that does not wait
    field: str  # s until it happens


SCHEDULES: dict[type[Task], Schedule] = {
    Push: Schedule("throw a ball", "next_throw"),
    Trampoline: Schedule("bounce", "next_bounce"),
    Ball: Schedule("nudge the ball", "next_push"),
    ChickenFight: Schedule("send the box", "next_attack"),
    SustainedPush: Schedule("next push or pause", "left"),
}
PARAMETERS: dict[type[Task], dict[str, tuple[float, float]]] = {
    Door: {"width": (0.8, 1.8)},
}
"""Parameters of a task that a person may want to change, and their ranges. The scene
is another one then, and so is the program."""


def of(task: Task) -> list[Action]:
    """What a task offers."""
    found = []
    schedule = _schedule(task)
    if schedule is not None:
        found.append(Action(schedule.name, _now))
    if isinstance(task, HandInHand | Locomotion | SustainedPush):
        found += [
            Action("speed", _speed, 0.0, max(task.gaits.speeds), "m/s"),
            Action("turn", _turn, -task.gaits.turn_rate, task.gaits.turn_rate, "rad/s"),
        ]
    return found


def has_events(task: Task) -> bool:
    """Whether something happens by itself now and then."""
    return _schedule(task) is not None


def parameters(task: Task) -> dict[str, tuple[float, float]]:
    """Ranges of the parameters that may be changed with a new program."""
    return next((p for kind, p in PARAMETERS.items() if isinstance(task, kind)), {})


def waiting(task: Task, state: Any) -> Any:
    """The state with what happens by itself put off by a control step."""
    schedule = _schedule(task)
    if schedule is None:
        return state
    left = float(getattr(state, schedule.field))
    put_off = max(left, float(getattr(task, "interval", 1.0)))
    # What has begun goes on: a kick of the plate, an attack.
    return state if left <= 0.0 else _with(state, **{schedule.field: put_off})


def _schedule(task: Task) -> Schedule | None:
    return next((s for kind, s in SCHEDULES.items() if isinstance(task, kind)), None)


def _now(task: Task, state: Any, value: float | None) -> Any:
    schedule = _schedule(task)
    assert schedule is not None
    return _with(state, **{schedule.field: 0.0})


def _speed(task: Task, state: Any, value: float | None) -> Any:
    return _led(state, wanted_speed=value)


def _turn(task: Task, state: Any, value: float | None) -> Any:
    return _led(state, wanted_turn=value)


def _led(state: Any, **wanted: float | None) -> Any:
    """The path goes where it is told from now on, and wants nothing else."""
    values = {k: float(v) for k, v in wanted.items() if v is not None}
    return dataclasses.replace(state, motion=_with(state.motion, left=LONG, **values))


def _with(state: Any, **values: float) -> Any:
    """The state with numbers in place."""
    assert all(math.isfinite(value) for value in values.values())
    numbers = {name: np.float32(value) for name, value in values.items()}
    return dataclasses.replace(state, **numbers)
