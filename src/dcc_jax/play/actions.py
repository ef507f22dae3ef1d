"""What a person may have a task do: throw, bounce, bump, lead elsewhere.

A task names its `event`. Everything here sets numbers of the task's own state, outside
the compiled program.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dcc_jax.env.task import Task
from dcc_jax.tasks.hand_in_hand import HandInHand
from dcc_jax.tasks.locomotion import Locomotion
from dcc_jax.tasks.sustained_push import SustainedPush

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


def of(task: Task) -> list[Action]:
    """What a task offers."""
    found = [] if task.event is None else [Action(task.event.name, _now)]
    if isinstance(task, HandInHand | Locomotion | SustainedPush):
        found += [
            Action("speed", _speed, 0.0, max(task.gaits.speeds), "m/s"),
            Action("turn", _turn, -task.gaits.turn_rate, task.gaits.turn_rate, "rad/s"),
        ]
    return found


def waiting(task: Task, state: Any) -> Any:
    """The state with what happens by itself put off by a control step."""
    if task.event is None:
        return state
    left = float(getattr(state, task.event.countdown))
    put_off = max(left, float(getattr(task, "interval", 1.0)))
    # What has begun goes on: a kick of the plate, an attack.
    return state if left <= 0.0 else _with(state, **{task.event.countdown: put_off})


def _now(task: Task, state: Any, value: float | None) -> Any:
    assert task.event is not None
    return _with(state, **{task.event.countdown: 0.0})


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
