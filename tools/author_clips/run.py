"""Running and jogging."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dcc_jax.character import GRAVITY
from tools.author_clips.dynamics import Solved, cropped, solve
from tools.author_clips.gaits import Step, stride_holds
from tools.author_clips.stand import SIDES
from tools.author_clips.steps import Foothold, ramp
from tools.author_clips.style import (
    RATE,
    Style,
    gait_plan,
    height_path,
    stand_height,
    times,
)

RUN = Style(
    lean=0.06,
    bend=0.08,
    swing=0.75,
    out=0.20,
    flex=1.45,
    flex_swing=0.3,
    yaw=0.14,
    counter=1.6,
    roll=0.03,
    sway=0.0,
)
RUN_PRESSURE = (0.08, 0.15)  # m ahead of the ankle
RUN_FOOT = {
    "strike": -0.12,
    "push": 0.90,
    "flatten": 0.06,
    "peel": 0.14,
    "early": 0.42,
    "curl": -0.5,
    "lag": 0.12,
    "take": 0.03,
    "shed": 0.03,
}


START = ((0.40, 0.50, 0.48), (0.60, 0.40, 0.33), (0.80, 0.36, 0.26))
STOP = (
    (0.99, 0.35, 0.21),
    (0.89, 0.35, 0.23),
    (0.79, 0.36, 0.26),
    (0.67, 0.37, 0.30),
    (0.54, 0.38, 0.42),
    (0.40, 0.40, 0.50),
    (0.22, 0.42, 0.56),
    (0.00, 0.45, 10.0),
)
"""Steps before and after a steady run: share of its step's length, period, contact."""


@dataclass(frozen=True)
class Pace:
    """A steady run; what is left of the period after the contact is flight."""

    speed: float = 3.0  # m/s
    period: float = 10 / 30  # s, of a step
    contact: float = 0.20  # s
    level: float = 0.03  # m, above the stand when it leaves the ground
    drop: float = 0.03  # m, how much lower the body lands than it took off
    width: float = 0.045  # m, of a foot from the path
    clearance: float = 0.16  # m, of a swinging foot
    flex: float = 1.45  # rad, of the elbows

    def step(self, turn: float = 0.0) -> Step:
        """One step of it."""
        length = self.speed * self.period
        return Step(length, self.period, self.contact, turn, self.width)

    @property
    def foot(self) -> dict[str, float]:
        """How the feet roll and swing."""
        return RUN_FOOT | {"clearance": self.clearance}


JOG = Pace(2.0, 11 / 30, 0.26, level=0.01, drop=0.015, width=0.055, clearance=0.11)


def run(pace: Pace = Pace(), turn: float = 0.0, steps: int = 7) -> Solved:
    """Running from stand to stand, turning `turn` rad in every steady step."""
    steady = pace.step(turn)
    ends = (
        [
            Step(share * steady.length, period, max(contact, pace.contact))
            for share, period, contact in part
        ]
        for part in (START, STOP)
    )
    first, last = ends
    start = 0.8
    holds = stride_holds(start, [*first, *[steady] * steps, *last], pace.foot)
    end = max(track[-1].land for track in holds)
    t = times(end + 1.0)
    height = height_path(t, _running_knots(holds, start, end, pace))
    moving = ramp(t, start - 0.4, start + 0.5) * (1.0 - ramp(t, end - 0.8, end + 0.3))
    style = replace(
        RUN,
        lean=0.03 + (RUN.lean - 0.03) * moving,
        bend=0.02 + (RUN.bend - 0.02) * moving,
        flex=0.26 + (pace.flex - 0.26) * moving,
    )
    return solve(gait_plan(t, holds, height, style, pressure=RUN_PRESSURE))


def _running_knots(
    holds: tuple[list[Foothold], list[Foothold]], start: float, end: float, pace: Pace
) -> list[tuple[float, ...]]:
    """Height: ballistic where neither foot is down, level in longer stances."""
    high, level = stand_height(), stand_height() + pace.level
    low, settle = level - 0.05, 0.20
    knots: list[tuple[float, ...]] = [(0.0, high), (start - 0.2, high)]
    lifted, landed = start, start
    for land, lift in sorted((h.land, h.lift) for track in holds for h in track):
        if lifted < land:
            if lifted - landed > 2.5 * settle:
                first = max(landed + settle, start + settle)
                knots += [(first, low), (lifted - settle, low)]
            knots += flight_knots(lifted, land, level, pace.drop)
            landed = land
        lifted = max(lifted, lift)
    return [*knots, (landed + settle, low), (end, low), (end + 0.7, high)]


def flight_knots(
    lift: float, land: float, level: float, drop: float
) -> list[tuple[float, ...]]:
    """The two ends of a flight from `level` to a landing up to `drop` m lower.

    Landing lower puts the greatest force early in the stance, and so the foot less
    far ahead of the body when it lands than behind when it leaves.
    """
    air = land - lift
    drop = drop * (air / 0.15) ** 2
    leave = 0.5 * GRAVITY * air - drop / air
    return [
        (lift, level, leave, -GRAVITY),
        (land, level - drop, leave - GRAVITY * air, -GRAVITY),
    ]


def run_cycle(pace: Pace = Pace()) -> Solved:
    """One stride of a steady run, a loop."""
    count, step = 18, pace.step()
    holds: tuple[list[Foothold], list[Foothold]] = ([], [])
    knots: list[tuple[float, ...]] = []
    for index in range(count):
        side, land = index % 2, index * step.period - 0.5
        lift = land + step.contact
        place = (index * step.length, SIDES[side] * step.width, 0.05 * SIDES[side])
        holds[side].append(Foothold(*place, land=land, lift=lift, **pace.foot))
        level = stand_height() + pace.level
        knots += flight_knots(lift, land + step.period, level, pace.drop)
    t = times((count - 4) * step.period)
    style = replace(RUN, flex=pace.flex)
    plan = gait_plan(t, holds, height_path(t, knots), style, pressure=RUN_PRESSURE)
    middle = 0.5 * step.contact - 0.5
    ends = [[pace.speed * (moment - middle) + 0.10, 0.0] for moment in (t[0], t[-1])]
    solved = solve(replace(plan, ends=np.array(ends)))
    first = round(7 * step.period * RATE)
    return cropped(solved, first, first + round(2 * step.period * RATE) + 1)
