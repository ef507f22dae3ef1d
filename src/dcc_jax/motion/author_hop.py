"""Hopping on one leg."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcc_jax.motion.author_dynamics import Solved, solve
from dcc_jax.motion.author_kinematics import ANKLE_HEIGHT, GRAVITY
from dcc_jax.motion.author_stand import SIDES, home
from dcc_jax.motion.author_steps import Foothold, bump, ramp
from dcc_jax.motion.author_style import (
    Style,
    arms,
    gait_plan,
    height_path,
    stand_height,
    times,
)

CONTACT, AIR = 0.28, 0.20  # s
LENGTH = 0.20  # m, of a hop
ROUTE = ((0.0, 4), (90.0, 4), (45.0, 3), (135.0, 3))  # degrees, hops each way


def there_and_back() -> list[float]:
    """Direction of every hop, rad, 0 ahead and pi/2 left: all eight, some in a row."""
    route = []
    for degrees, count in ROUTE:
        route += [np.radians(degrees)] * count + [np.radians(degrees + 180.0)] * count
    return route


def hop(duration: float = 17.0, side: int = 0) -> Solved:
    """Hopping on one leg in all directions and back, the other leg drawn up."""
    begin = 1.3
    rate = 0.5 * GRAVITY * AIR
    top, level = stand_height() - 0.02, stand_height() + 0.07
    knots: list[tuple[float, ...]] = [(0.0, stand_height() - 0.005), (begin - 0.3, top)]
    hopping, x, y = [home(side)], home(side).x, SIDES[side] * 0.05
    hopping[0] = replace(hopping[0], y=y)
    now = begin + 0.25
    for direction in there_and_back():
        x, y = x + LENGTH * np.cos(direction), y + LENGTH * np.sin(direction)
        knots.append((now, level, rate, -GRAVITY))
        hopping[-1] = replace(
            hopping[-1],
            lift=now,
            push=0.6,
            peel=0.13,
            shed=0.01,
            clearance=0.06,
            snap=1.6,
        )
        now += AIR
        knots.append((now, level, -rate, -GRAVITY))
        spot = Foothold(x, y, 0.0, land=now, strike=0.25, flatten=0.07, take=0.01)
        hopping.append(spot)
        now += CONTACT
    knots += [(now + 0.3, top), (duration, stand_height() - 0.005)]
    lift, down = begin - 0.55, now + 0.45
    other = home(1 - side)
    waiting = [
        replace(other, lift=lift, shed=0.4, push=0.3, clearance=0.1),
        replace(other, x=x, y=y - SIDES[side] * 0.16, land=down, take=0.3),
    ]
    holds = (hopping, waiting) if side == 0 else (waiting, hopping)
    t = times(duration)
    drawn = ramp(t, lift, lift + 0.45) * (1.0 - ramp(t, down - 0.45, down))
    beat = bump(np.mod((t - begin) / (CONTACT + AIR), 1.0)) * drawn
    swing = 0.15 + 0.25 * beat
    out = 0.18 + 0.45 * drawn
    limbs = arms(swing, swing, out, 0.3 + 0.6 * drawn, 0.3 + 0.6 * drawn)
    style = Style(lean=0.08, bend=0.04, roll=0.02, sway=0.03, yaw=0.0)
    plan = gait_plan(t, holds, height_path(t, knots), style, limbs=limbs)
    tucked = np.zeros((len(t), 2))
    tucked[:, 1 - side] = drawn
    place = np.array([-0.16, -SIDES[side] * 0.09, -0.56 + ANKLE_HEIGHT])
    tuck = np.tile(place, (len(t), 2, 1))
    return solve(replace(plan, tuck=tuck, tucked=tucked))
