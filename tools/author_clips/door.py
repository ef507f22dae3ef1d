"""Opening a door: reach for the knob, push while stepping through, let go.

The door is closed in the plane x = KNOB[0]; its hinge is `WIDTH` to the right of the
knob, and it swings away from the character.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcc_jax.tasks import door
from dcc_jax.tasks.door import GRASP_TIME, OPENING, RELEASE_TIME
from tools.author_clips.dynamics import Solved, solve
from tools.author_clips.gaits import Step, stride_holds
from tools.author_clips.steps import ramp
from tools.author_clips.style import Style, gait_plan, stand_height, times

DURATION = 5.0  # s (Sec. 5.3)
KNOB = np.array(door.KNOB)  # m
WIDTH = door.Door().width  # m, from hinge to knob
HINGE = KNOB[:2] - [0.0, WIDTH]  # m
FOOT = {"strike": -0.08, "push": 0.35, "peel": 0.22, "clearance": 0.04}


def knob_path(t: np.ndarray) -> np.ndarray:
    """The knob [T, 3] in m while the door opens."""
    angle = OPENING * ramp(t, GRASP_TIME, RELEASE_TIME)
    circle = WIDTH * np.stack([np.sin(angle), np.cos(angle)], -1)
    return np.concatenate([HINGE + circle, np.full((*t.shape, 1), KNOB[2])], -1)


def open_door() -> Solved:
    """Five seconds from stand to stand, the right hand on the knob's circle."""
    t = times(DURATION)
    contact = 0.62
    steps = [
        Step(0.24, 0.50, contact, -0.06, 0.09),
        Step(0.26, 0.48, contact, -0.10, 0.09),
        Step(0.26, 0.48, contact, -0.10, 0.09),
        Step(0.16, 0.48, contact, -0.06, 0.09),
        Step(0.0, 0.50, 10.0),
    ]
    holds = stride_holds(1.60, steps, FOOT)
    busy = ramp(t, 0.5, 1.3) * (1.0 - ramp(t, RELEASE_TIME, RELEASE_TIME + 0.7))
    style = Style(lean=0.03 + 0.09 * busy, bend=0.02 + 0.05 * busy, swing=0.4)
    plan = gait_plan(t, holds, np.full(len(t), stand_height() - 0.01), style)
    grasp = ramp(t, 0.45, GRASP_TIME) * (
        1.0 - ramp(t, RELEASE_TIME, RELEASE_TIME + 0.7)
    )
    return solve(replace(plan, palm=knob_path(t), grasp=grasp))
