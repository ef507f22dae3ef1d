"""Steps in a row, and walking."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tools.author_clips.dynamics import Solved, cropped, solve
from tools.author_clips.stand import SIDES, home
from tools.author_clips.steps import Foothold
from tools.author_clips.style import RATE, Style, gait_plan, stand_height, times

LEG = 0.88  # m, from the sole to the hip
WALK = Style(lean=-0.02, bend=0.03, swing=0.70, out=0.13, yaw=0.16, flex=0.25)
WALK_FOOT = {
    "strike": -0.30,
    "push": 1.0,
    "flatten": 0.10,
    "peel": 0.28,
    "clearance": 0.03,
    "early": 0.35,
    "curl": -0.5,
}


@dataclass(frozen=True)
class Step:
    """One step: the foot lands `period` after the other one and stays for `contact`."""

    length: float  # m, along the path from the other foot
    period: float  # s
    contact: float  # s
    turn: float = 0.0  # rad, change of heading
    width: float = 0.07  # m, from the path


def stride_holds(
    start: float, steps: list[Step], foot: dict[str, float]
) -> tuple[list[Foothold], list[Foothold]]:
    """Footholds of a stand, steps beginning with the left foot, and a stand.

    Args:
        start: when the first foot lifts, s.
        steps: in order; the last one brings the feet together.
        foot: how the feet roll and swing (fields of `Foothold`).
    """
    holds = ([home(0)], [home(1)])
    x, y, yaw = holds[0][0].x, 0.0, 0.0
    land = start - 0.12
    lifts = [start, start + steps[0].period]
    for index, step in enumerate(steps):
        side, last = index % 2, index >= len(steps) - 2
        land += step.period
        yaw += step.turn
        x += step.length * np.cos(yaw - 0.5 * step.turn)
        y += step.length * np.sin(yaw - 0.5 * step.turn)
        overlap = max(lifts[1 - side] - land, 0.12)
        gives = {"shed": overlap, "take": overlap} | foot
        if index == 0:
            gives |= {"shed": 0.35, "push": 0.5 * foot["push"], "curl": 0.0}
        holds[side][-1] = replace(holds[side][-1], lift=lifts[side], **_leaving(gives))
        width = home(0).y if last else step.width
        toe_out = home(side).yaw if last else 0.07 * SIDES[side]
        spot = Foothold(
            x - SIDES[side] * width * np.sin(yaw),
            y + SIDES[side] * width * np.cos(yaw),
            yaw + toe_out,
            land=land,
        )
        holds[side].append(replace(spot, **_arriving(gives)))
        lifts[side] = land + step.contact
    return holds


def _leaving(foot: dict[str, float]) -> dict[str, float]:
    names = ("push", "peel", "clearance", "early", "curl", "lag", "shed")
    return {name: foot[name] for name in names if name in foot}


def _arriving(foot: dict[str, float]) -> dict[str, float]:
    names = ("strike", "flatten", "take")
    return {name: foot[name] for name in names if name in foot}


@dataclass(frozen=True)
class Pace:
    """A steady walk."""

    length: float = 0.60  # m, of a step
    period: float = 15 / 30  # s, of a step
    both: float = 0.10  # s, with both feet on the ground


SLOW = Pace(0.48, 18 / 30, 0.16)
FAST = Pace(1.6 * 13 / 30, 13 / 30, 0.07)


def walk(turn: float = 0.0, steps: int = 12, pace: Pace = Pace()) -> Solved:
    """Walking from a stand to a stand, turning `turn` rad a step."""
    length, contact = pace.length, pace.period + pace.both
    row = [Step(length, pace.period, contact, turn) for _ in range(steps)]
    row[0] = Step(0.45 * length, pace.period + 0.07, contact + 0.07)
    row[1] = replace(row[1], length=0.9 * length)
    row[-2] = Step(0.6 * length, pace.period, contact + 0.1)
    row[-1] = Step(0.0, pace.period + 0.05, 10.0)
    start = 0.9
    holds = stride_holds(start, row, WALK_FOOT)
    end = holds[(steps - 1) % 2][-1].land
    t = times(end + 1.0)
    height = stand_height() - vaulting(t, holds, start, end)
    return solve(gait_plan(t, holds, height, WALK, pressure=(0.05, 0.15)))


def vaulting(
    t: np.ndarray,
    holds: tuple[list[Foothold], list[Foothold]],
    start: float,
    end: float,
) -> np.ndarray:
    """How far a walking body sinks [T] (m): not over one foot, most between two."""
    moments, sinks = [start - 0.3], [0.0]
    row = sorted([*holds[0][1:], *holds[1]], key=lambda hold: hold.land)
    for behind, ahead in pairwise(row):
        apart = np.hypot(ahead.x - behind.x, ahead.y - behind.y)
        moments.append(0.5 * (ahead.land + min(behind.lift, end + 0.2)))
        sinks.append(0.45 * (LEG - np.sqrt(LEG**2 - 0.25 * apart**2)))
    moments.append(end + 0.6)
    sinks.append(0.0)
    beat = np.interp(t, moments, np.arange(len(moments)))
    sink = np.interp(t, moments, sinks) * np.cos(np.pi * beat) ** 2
    return gaussian_filter1d(sink, 0.03 * RATE, mode="nearest")


def walk_cycle(pace: Pace = Pace()) -> Solved:
    """One stride of a steady walk, a loop."""
    solved = walk(steps=18, pace=pace)
    first = round(9 * pace.period * RATE)
    return cropped(solved, first, first + round(2 * pace.period * RATE) + 1)
