"""Hopping on one leg."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from dcc_jax.character import GRAVITY
from tools.author_clips.dynamics import Solved, cropped, solve
from tools.author_clips.kinematics import ANKLE_HEIGHT
from tools.author_clips.stand import SIDES, home
from tools.author_clips.steps import Foothold, bump, ramp
from tools.author_clips.style import (
    RATE,
    Style,
    arms,
    gait_plan,
    height_path,
    stand_height,
    times,
)

CONTACT, AIR = 0.28, 0.20  # s
LENGTH = 0.20  # m, of a hop
LEVEL = 0.07  # m, of the centre of mass above the stand, when it leaves and lands
OFF = {"push": 0.6, "peel": 0.13, "shed": 0.01, "clearance": 0.06, "snap": 1.6}
ON = {"strike": 0.25, "flatten": 0.07, "take": 0.01}
BEGIN = 1.3  # s, when it has drawn the other leg up
IN_CYCLE = 5  # hops, a whole number of frames
ROUTE = ((0.0, 4), (90.0, 4), (45.0, 3), (135.0, 3))  # degrees, hops each way


def there_and_back() -> list[complex]:
    """Hops of LENGTH m, real ahead and imaginary left: to all eight sides, some in a
    row."""
    route = []
    for degrees, count in ROUTE:
        hop = LENGTH * np.exp(1j * np.radians(degrees))
        route += [hop] * count + [-hop] * count
    return route


def hop_cycle(x: float, y: float) -> Solved:
    """Five hops of a steady hopping on the left leg, a loop, by (x, y) m each."""
    count, before = 4 * IN_CYCLE, 2 * IN_CYCLE
    hops = [complex(x, y)] * count
    solved = hop(3.7 + count * (CONTACT + AIR), hops=hops)
    first = round((BEGIN + before * (CONTACT + AIR)) * RATE)
    return cropped(solved, first, first + round(IN_CYCLE * (CONTACT + AIR) * RATE) + 1)


def hop(
    duration: float = 17.0, side: int = 0, hops: Sequence[complex] | None = None
) -> Solved:
    """Hopping on one leg, the other leg drawn up, from a stand to a stand.

    Args:
        duration: of the clip, s.
        side: of the leg, 0 left and 1 right.
        hops: x + iy of each, m; None: in all directions and back.
    """
    t, begin = times(duration), BEGIN
    hopping = _hops(begin + 0.25, side, there_and_back() if hops is None else hops)
    lift, down = begin - 0.55, hopping[-1].land + CONTACT + 0.45
    other = home(1 - side)
    beside = {"x": hopping[-1].x, "y": hopping[-1].y - SIDES[side] * 0.16}
    waiting = [
        replace(other, lift=lift, shed=0.4, push=0.3, clearance=0.1),
        replace(other, **beside, land=down, take=0.3),
    ]
    holds = (hopping, waiting) if side == 0 else (waiting, hopping)
    drawn = ramp(t, lift, lift + 0.45) * (1.0 - ramp(t, down - 0.45, down))
    beat = bump(np.mod((t - begin) / (CONTACT + AIR), 1.0)) * drawn
    swing, bent = 0.15 + 0.25 * beat, 0.3 + 0.6 * drawn
    limbs = arms(swing, swing, 0.18 + 0.45 * drawn, bent, bent)
    style = Style(lean=0.08, bend=0.04, roll=0.02, sway=0.03, yaw=0.0)
    height = height_path(t, _knots(hopping, begin, duration))
    plan = gait_plan(t, holds, height, style, limbs=limbs)
    tucked = np.zeros((len(t), 2))
    tucked[:, 1 - side] = drawn
    place = np.array([-0.16, -SIDES[side] * 0.09, -0.56 + ANKLE_HEIGHT])
    return solve(replace(plan, tuck=np.tile(place, (len(t), 2, 1)), tucked=tucked))


def _hops(leave: float, side: int, hops: Sequence[complex]) -> list[Foothold]:
    """Footholds of the hopping foot, the first of which it leaves at `leave` s."""
    start = home(side)
    spots = [replace(start, y=SIDES[side] * 0.05)]
    for hop in hops:
        spots[-1] = replace(spots[-1], lift=leave, **OFF)
        x, y = spots[-1].x + hop.real, spots[-1].y + hop.imag
        spots.append(Foothold(x, y, 0.0, land=leave + AIR, **ON))
        leave += AIR + CONTACT
    return spots


def _knots(
    hopping: list[Foothold], begin: float, duration: float
) -> list[tuple[float, ...]]:
    """Height: a parabola between two footholds, a stand before and after."""
    stand, rate = stand_height(), 0.5 * GRAVITY * AIR
    knots: list[tuple[float, ...]] = [(0.0, stand - 0.005), (begin - 0.3, stand - 0.02)]
    for before, after in pairwise(hopping):
        knots.append((before.lift, stand + LEVEL, rate, -GRAVITY))
        knots.append((after.land, stand + LEVEL, -rate, -GRAVITY))
    settled = hopping[-1].land + CONTACT + 0.3
    return [*knots, (settled, stand - 0.02), (duration, stand - 0.005)]
