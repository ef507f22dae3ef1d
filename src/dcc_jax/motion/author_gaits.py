"""Walking, running and hopping on one leg."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dcc_jax.motion.author_dynamics import Solved, cropped, solve
from dcc_jax.motion.author_kinematics import ANKLE_HEIGHT, GRAVITY
from dcc_jax.motion.author_stand import SIDES, home
from dcc_jax.motion.author_steps import Foothold, bump, ramp
from dcc_jax.motion.author_style import (
    RATE,
    Style,
    arms,
    gait_plan,
    height_path,
    stand_height,
    times,
)

WALK = Style(lean=0.05, bend=0.02, swing=0.70, out=0.13, yaw=0.16, flex=0.25)
RUN = Style(
    lean=0.14,
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
WALK_FOOT = {
    "strike": -0.30,
    "push": 0.68,
    "flatten": 0.12,
    "peel": 0.28,
    "clearance": 0.035,
    "early": 0.40,
}
RUN_FOOT = {
    "strike": -0.12,
    "push": 0.75,
    "flatten": 0.06,
    "peel": 0.14,
    "clearance": 0.16,
    "early": 0.42,
    "curl": 0.10,
    "take": 0.03,
    "shed": 0.03,
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
            gives |= {"shed": 0.35}
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
    names = ("push", "peel", "clearance", "early", "curl", "shed")
    return {name: foot[name] for name in names if name in foot}


def _arriving(foot: dict[str, float]) -> dict[str, float]:
    names = ("strike", "flatten", "take")
    return {name: foot[name] for name in names if name in foot}


def walk(turn: float = 0.0, steps: int = 12, length: float = 0.64) -> Solved:
    """Walking at 1.2 m/s from a stand to a stand, turning `turn` rad a step."""
    period, both = 32 / 60, 0.11
    pace = [Step(length, period, period + both, turn) for _ in range(steps)]
    pace[0] = Step(0.45 * length, 0.60, 0.60 + both)
    pace[1] = replace(pace[1], length=0.9 * length)
    pace[-2] = Step(0.6 * length, period, period + both + 0.1)
    pace[-1] = Step(0.0, period + 0.05, 10.0)
    start = 0.9
    holds = stride_holds(start, pace, WALK_FOOT)
    end = holds[(steps - 1) % 2][-1].land
    t = times(end + 1.0)
    moving = ramp(t, start - 0.2, start + 0.5) * (1.0 - ramp(t, end - 0.5, end + 0.4))
    height = stand_height() - 0.012 * moving
    return solve(gait_plan(t, holds, height, WALK, pressure=(0.0, 0.12)))


def walk_cycle() -> Solved:
    """One stride of steady walking at 1.2 m/s, a loop."""
    solved = _steady_walk()
    stride = round(64 / 60 * RATE)
    first = round(5.0 * RATE)
    return cropped(solved, first, first + stride + 1)


def _steady_walk() -> Solved:
    return walk(steps=18)


STRIDE = 0.35  # s between landings of a run
CONTACT = 0.20


def run(speed: float = 3.0) -> Solved:
    """Running from stand to stand; a step shorter in contact than its period flies."""
    steady = Step(speed * STRIDE, STRIDE, CONTACT, width=0.045)
    steps = [
        Step(0.40, 0.50, 0.40 + 0.08),
        Step(0.60, 0.40, 0.33),
        Step(0.80, 0.36, 0.26),
        *[steady] * 7,
        Step(0.99, STRIDE, 0.21, width=0.05),
        Step(0.89, STRIDE, 0.23),
        Step(0.79, 0.36, 0.26),
        Step(0.67, 0.37, 0.30),
        Step(0.54, 0.38, 0.42),
        Step(0.40, 0.40, 0.50),
        Step(0.22, 0.42, 0.56),
        Step(0.0, 0.45, 10.0),
    ]
    start = 0.8
    holds = stride_holds(start, steps, RUN_FOOT)
    end = max(track[-1].land for track in holds)
    t = times(end + 1.0)
    height = height_path(t, _running_knots(holds, start, end))
    moving = ramp(t, start - 0.4, start + 0.5) * (1.0 - ramp(t, end - 0.8, end + 0.3))
    style = replace(
        RUN,
        lean=0.03 + (RUN.lean - 0.03) * moving,
        bend=0.02 + (RUN.bend - 0.02) * moving,
        flex=0.26 + (RUN.flex - 0.26) * moving,
    )
    return solve(gait_plan(t, holds, height, style, pressure=(0.03, 0.11)))


def _running_knots(
    holds: tuple[list[Foothold], list[Foothold]], start: float, end: float
) -> list[tuple[float, ...]]:
    """Height: ballistic where neither foot is down, level in longer stances."""
    high, level = stand_height() - 0.01, stand_height() - 0.05
    low, settle = level - 0.02, 0.20
    knots: list[tuple[float, ...]] = [(0.0, high), (start - 0.2, high)]
    lifted, landed = start, start
    for land, lift in sorted((h.land, h.lift) for track in holds for h in track):
        if lifted < land:
            if lifted - landed > 2.5 * settle:
                first = max(landed + settle, start + settle)
                knots += [(first, low), (lifted - settle, low)]
            rate = 0.5 * GRAVITY * (land - lifted)
            knots += [(lifted, level, rate, -GRAVITY), (land, level, -rate, -GRAVITY)]
            landed = land
        lifted = max(lifted, lift)
    return [*knots, (landed + settle, low), (end, low), (end + 0.7, high)]


def run_cycle(speed: float = 3.0) -> Solved:
    """One stride of steady running, a loop."""
    count = 18
    steady = Step(speed * STRIDE, STRIDE, CONTACT, width=0.045)
    holds: tuple[list[Foothold], list[Foothold]] = ([], [])
    for index in range(count):
        side = index % 2
        holds[side].append(
            Foothold(
                index * steady.length,
                SIDES[side] * steady.width,
                0.05 * SIDES[side],
                land=index * STRIDE - 0.5,
                lift=index * STRIDE - 0.5 + CONTACT,
                **RUN_FOOT,
            )
        )
    t = times((count - 4) * STRIDE)
    knots, air = [], STRIDE - CONTACT
    level, rate = stand_height() - 0.05, 0.5 * GRAVITY * air
    for index in range(count):
        land = index * STRIDE - 0.5
        knots.append((land, level, -rate, -GRAVITY))
        knots.append((land + CONTACT, level, rate, -GRAVITY))
    plan = gait_plan(t, holds, height_path(t, knots), RUN, pressure=(0.03, 0.11))
    middle = 0.5 * CONTACT - 0.5
    ends = [[speed * (moment - middle) + 0.07, 0.0] for moment in (t[0], t[-1])]
    solved = solve(replace(plan, ends=np.array(ends)))
    first = round(7 * STRIDE * RATE)
    return cropped(solved, first, first + round(2 * STRIDE * RATE) + 1)


def hop(duration: float = 17.0, side: int = 0) -> Solved:
    """Hopping on one leg, once round all directions and back, other leg drawn up."""
    contact, air = 0.30, 0.20
    begin, finish = 1.3, duration - 1.5
    count = int((finish - begin) / (contact + air))
    rate = 0.5 * GRAVITY * air
    top, level = stand_height() - 0.03, stand_height() - 0.05
    knots: list[tuple[float, ...]] = [(0.0, stand_height() - 0.005), (begin - 0.3, top)]
    hopping, x, y = [home(side)], home(side).x, SIDES[side] * 0.05
    hopping[0] = replace(hopping[0], y=y)
    now = begin + 0.25
    for index in range(count):
        direction = 2.0 * np.pi * (index // 2) / 12.0
        length = 0.20 if index % 2 == 0 else -0.20
        x, y = x + length * np.cos(direction), y + length * np.sin(direction)
        knots.append((now, level + 0.02, rate, -GRAVITY))
        hopping[-1] = replace(
            hopping[-1],
            lift=now,
            push=0.5,
            peel=0.13,
            shed=0.01,
            clearance=0.06,
            snap=1.6,
        )
        now += air
        knots.append((now, level + 0.02, -rate, -GRAVITY))
        spot = Foothold(x, y, 0.0, land=now, strike=0.25, flatten=0.07, take=0.01)
        hopping.append(spot)
        now += contact
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
    beat = bump(np.mod((t - begin) / (contact + air), 1.0)) * drawn
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
