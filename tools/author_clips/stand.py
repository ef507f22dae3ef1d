"""Clips on the spot: the quiet stand, recovery steps, balance with small steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.author_clips.dynamics import Solved, cropped, solve
from tools.author_clips.kinematics import about
from tools.author_clips.steps import Foothold, ramp
from tools.author_clips.style import (
    RATE,
    Style,
    arms,
    gait_plan,
    keyed,
    stand_height,
    times,
)

HOME_WIDTH = 0.095  # m, of each foot from the middle
TOE_OUT = 0.10  # rad
SIDES = (1.0, -1.0)


def home(side: int, **changes: float) -> Foothold:
    """The foothold of a relaxed stand at the origin; side 0 is left, 1 right."""
    sign = SIDES[side]
    return replace(Foothold(-0.02, sign * HOME_WIDTH, sign * TOE_OUT), **changes)


def _waves(
    t: np.ndarray, parts: list[tuple[float, int, float]], period: float
) -> np.ndarray:
    """Sum of sines (amplitude, cycles a period, phase)."""
    waves = [a * np.sin(2 * np.pi * n * t / period + shift) for a, n, shift in parts]
    return np.sum(waves, axis=0)


def stand(period: float = 10.0) -> Solved:
    """A quiet stand that sways: one period of a loop."""
    t = times(3.0 * period)
    sway_x = _waves(t, [(0.010, 2, 0.0), (0.005, 5, 1.0), (0.003, 7, 2.0)], period)
    sway_y = _waves(t, [(0.022, 1, 0.5), (0.006, 3, 0.0), (0.003, 8, 1.5)], period)
    breath = _waves(t, [(1.0, 3, 0.0)], period)
    look = _waves(t, [(0.10, 1, 0.0), (0.04, 2, 1.0)], period)
    limbs = arms(
        0.02 + 0.02 * sway_x / 0.01,
        0.02 - 0.015 * sway_x / 0.01,
        0.15 + 0.008 * breath,
        0.28 + 0.02 * breath,
        0.26 + 0.02 * breath,
    )
    plan = gait_plan(
        t,
        ([home(0)], [home(1)]),
        stand_height() + 0.0015 * breath,
        Style(),
        limbs=limbs,
    )
    tilt = about("x", -0.8 * sway_y)[:, None] @ about("z", 0.15 * look)[:, None]
    turned = np.concatenate([tilt, about("z", look)[:, None]], 1)
    upper = plan.upper.copy()
    upper[:, :2] = turned @ upper[:, :2]
    plan = replace(plan, upper=upper, shift=np.stack([sway_x, sway_y], 1))
    first = round(period * RATE)
    return cropped(solve(plan, rounds=4), first, 2 * first + 1)


def recovery(direction: float, reach: float = 0.36) -> Solved:
    """A quick step towards `direction` (rad, 0 ahead, pi/2 left) and back home.

    The foot of that side leads, the other follows; then both return.
    """
    ahead, left = np.cos(direction), np.sin(direction)
    lead = 1 if left < -0.1 or (abs(left) <= 0.1 and ahead > 0.0) else 0
    length = reach * (0.85 if abs(left) > 0.9 or ahead < -0.5 else 1.0)
    away = length * np.array([ahead, left])
    swing, pause = 0.30, 0.20
    out = 0.7
    follow = out + swing + pause
    back = follow + swing + 0.9
    home_again = back + 1.2 * swing + pause
    end = home_again + 1.2 * swing + 0.9
    quick = {"shed": 0.18, "take": 0.14, "clearance": 0.06, "push": 0.15, "peel": 0.15}

    def path(side: int, go: float, come: float) -> list[Foothold]:
        there = home(side)
        there = replace(there, x=there.x + away[0], y=there.y + away[1])
        return [
            home(side, lift=go, **quick),
            replace(there, land=go + swing, lift=come, **quick),
            home(side, land=come + 1.2 * swing, **(quick | {"push": 0.0})),
        ]

    tracks = [path(lead, out, home_again), path(1 - lead, follow, back)]
    holds = (tracks[0], tracks[1]) if lead == 0 else (tracks[1], tracks[0])
    t = times(end)
    alert = ramp(t, 0.3, 0.8) * (1.0 - ramp(t, end - 0.9, end))
    height = stand_height() - 0.035 * alert
    out_angle = 0.15 + 0.30 * alert
    bent = 0.26 + 0.4 * alert
    limbs = arms(0.15 * alert, 0.15 * alert, out_angle, bent, bent)
    return solve(gait_plan(t, holds, height, Style(), limbs=limbs))


def small_steps(duration: float = 12.0, seed: int = 3) -> Solved:
    """Keeping balance on the spot: small steps, arms held out and busy."""
    rng = np.random.default_rng(seed)
    holds: tuple[list[Foothold], list[Foothold]] = ([home(0)], [home(1)])
    now, side = 0.8, 0
    while now < duration - 1.4:
        swing = rng.uniform(0.24, 0.34)
        last = now > duration - 2.6
        spot = home(side)
        if not last:
            spot = replace(
                spot,
                x=spot.x + rng.uniform(-0.12, 0.12),
                y=spot.y + SIDES[side] * rng.uniform(-0.02, 0.10),
                yaw=spot.yaw + rng.uniform(-0.12, 0.12),
            )
        before = replace(
            holds[side][-1],
            lift=now,
            shed=0.16,
            clearance=rng.uniform(0.04, 0.08),
            push=0.10,
            peel=0.12,
        )
        holds[side][-1] = before
        holds[side].append(replace(spot, land=now + swing, take=0.14))
        now += swing + rng.choice([0.16, 0.22, 0.55], p=[0.4, 0.4, 0.2])
        side = 1 - side
    t = times(duration)
    keys = np.arange(0.0, duration + 0.5, 0.5)

    def wander(centre: float, spread: float) -> np.ndarray:
        values = centre + spread * rng.uniform(-1.0, 1.0, len(keys))
        return keyed(t, list(zip(keys, values, strict=True)))

    limbs = arms(
        wander(0.25, 0.2),
        wander(0.25, 0.2),
        wander(0.65, 0.2),
        wander(0.7, 0.2),
        wander(0.7, 0.2),
    )
    height = stand_height() - 0.045 + 0.0 * t
    return solve(gait_plan(t, holds, height, Style(lean=0.08, bend=0.08), limbs=limbs))
