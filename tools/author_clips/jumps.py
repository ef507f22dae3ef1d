"""Clips that leave the ground with both feet: jumps, jump series, backflip."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dcc_jax.character import GRAVITY
from tools.author_clips.dynamics import Plan, Solved, solve
from tools.author_clips.kinematics import about
from tools.author_clips.stand import home
from tools.author_clips.steps import Foothold, brisk, foot_track
from tools.author_clips.style import RATE, arms, height_path, keyed, stand_height, times


@dataclass(frozen=True)
class Jump:
    """One jump: how high the centre of mass rises after take-off, and to where."""

    rise: float = 0.20  # m
    x: float = 0.0  # m, of the landing
    y: float = 0.0
    yaw: float = 0.0  # rad
    rest: float = 0.0  # s, of standing after the landing


CROUCH = 0.24  # m, depth of the wind-up below the stand
ABSORB = 0.26  # m, depth of the landing
TAKE_OFF = 0.095  # m above the stand when the toes leave
TOUCH_DOWN = 0.06  # m above the stand when they land again
WIND_UP, PUSH_OFF = 0.55, 0.30  # s
LAND, RISE = 0.28, 0.60  # s, down into the landing, up from it
STAY = 0.12  # s, in the deep of the landing, before the next wind-up or the rise


def jumps(series: list[Jump], lead_in: float = 0.5, lead_out: float = 0.8) -> Solved:
    """Jumps one after the other, each landing absorbed, the last one into a stand."""
    top = stand_height()
    deep = top - CROUCH
    knots: list[tuple[float, ...]] = [(0.0, top)]
    holds: tuple[list[Foothold], list[Foothold]] = ([home(0)], [home(1)])
    lean, bend, swing, flex = ([(0.0, a)] for a in (0.03, 0.02, 0.05, 0.26))
    place, now, standing = Jump(), lead_in, True
    for jump in series:
        if standing:
            knots.append((now, top))
            for keys, value in (
                (lean, 0.03),
                (bend, 0.02),
                (swing, 0.05),
                (flex, 0.26),
            ):
                keys.append((now, value))
            now += WIND_UP
        knots.append((now, deep, 0.0, 5.0))
        lean.append((now, 0.62))
        bend.append((now, 0.35))
        swing.append((now, -0.85))
        flex.append((now, 0.2))
        leave = now + PUSH_OFF
        speed = np.sqrt(2.0 * GRAVITY * jump.rise)
        fall = np.sqrt(speed**2 + 2.0 * GRAVITY * (TAKE_OFF - TOUCH_DOWN))
        land = leave + (speed + fall) / GRAVITY
        knots.append((leave, top + TAKE_OFF, speed, -GRAVITY))
        knots.append((land, top + TOUCH_DOWN, -fall, -GRAVITY))
        low = land + LAND
        knots.append((low, top - ABSORB, 0.0, 4.0))
        air = 0.5 * (leave + land)
        lean += [(leave, 0.10), (air, 0.12), (land, 0.22), (low, 0.60)]
        bend += [(leave, 0.0), (air, 0.05), (land, 0.15), (low, 0.35)]
        swing += [(leave, 1.9), (air, 1.75), (land, 1.2), (low, 0.35)]
        flex += [(leave, 0.5), (air, 0.5), (land, 0.5), (low, 0.45)]
        place = replace(
            jump, x=place.x + jump.x, y=place.y + jump.y, yaw=place.yaw + jump.yaw
        )
        for side in (0, 1):
            holds[side][-1] = replace(
                holds[side][-1],
                lift=leave,
                push=0.65,
                peel=0.16,
                shed=0.02,
                clearance=jump.rise + 0.02,
                snap=1.5,
            )
            holds[side].append(_landing(side, place, land))
        now, standing = low + STAY, jump.rest > 0.0
        if standing or jump is series[-1]:
            knots.append((now, top - ABSORB + 0.01, 0.0, 2.0))
            now += RISE
            for keys, value in (
                (lean, 0.03),
                (bend, 0.02),
                (swing, 0.05),
                (flex, 0.26),
            ):
                keys.append((now, value))
            knots.append((now, top))
            now += jump.rest
    t = times(now + lead_out)
    plan = _two_footed(t, holds, height_path(t, knots), lean, bend, swing, flex)
    return solve(plan)


def _landing(side: int, place: Jump, land: float) -> Foothold:
    spot = home(side)
    cos, sin = np.cos(place.yaw), np.sin(place.yaw)
    return replace(
        spot,
        x=place.x + cos * spot.x - sin * spot.y,
        y=place.y + sin * spot.x + cos * spot.y,
        yaw=spot.yaw + place.yaw,
        land=land,
        strike=0.40,
        flatten=0.09,
        take=0.02,
    )


Keys = list[tuple[float, float]]


def _two_footed(
    t: np.ndarray,
    holds: tuple[list[Foothold], list[Foothold]],
    height: np.ndarray,
    lean: Keys,
    bend: Keys,
    swing: Keys,
    flex: Keys,
) -> Plan:
    """A symmetric plan from keys of trunk and arms."""
    feet = (
        foot_track(t, holds[0], (0.06, 0.06)),
        foot_track(t, holds[1], (0.06, 0.06)),
    )
    yaw = 0.5 * (feet[0].yaw + feet[1].yaw)
    tilt, curve = keyed(t, lean), keyed(t, bend)
    forward, elbow = keyed(t, swing), keyed(t, flex)
    trunk = [about("y", curve), about("y", -0.8 * np.sin(tilt + curve))]
    limbs = arms(forward, forward, 0.18, elbow, elbow)
    upper = np.concatenate([np.stack(trunk, 1), limbs], 1)
    pelvis = about("z", yaw) @ about("y", tilt)
    return Plan(1.0 / RATE, feet, height, pelvis, upper, adapt=False)


def backflip(rise: float = 0.56, back: float = 0.60) -> Solved:
    """A standing tucked backflip that lands `back` m behind its start."""
    top = stand_height()
    begin, crouch = 0.5, 1.05
    leave = crouch + 0.30
    speed = np.sqrt(2.0 * GRAVITY * rise)
    sink = 0.14
    fall = np.sqrt(speed**2 + 2.0 * GRAVITY * sink)
    land = leave + (speed + fall) / GRAVITY
    air, low = 0.5 * (leave + land), land + 0.32
    end = low + 0.75
    turn = 2.0 * np.pi
    height = [
        (0.0, top),
        (begin, top),
        (crouch, top - 0.26, 0.0, 6.0),
        (leave, top + TAKE_OFF, speed, -GRAVITY),
        (land, top + TAKE_OFF - sink, -fall, -GRAVITY),
        (low, top - 0.33, 0.0, 4.0),
        (end, top),
    ]
    lean = [
        (begin, 0.03),
        (crouch, 0.50),
        (leave - 0.14, 0.20),
        (leave, -0.30),
        (leave + 0.10, -0.8),
        (air, 0.25 - 0.5 * turn),
        (land - 0.12, 0.4 - turn),
        (land, 0.0 - turn),
        (land + 0.12, 0.25 - turn),
        (low, 0.50 - turn),
        (end, 0.03 - turn),
    ]
    bend = [(begin, 0.02), (crouch, 0.30), (leave, -0.40), (leave + 0.22, 0.65)]
    bend += [(land - 0.2, 0.40), (land, 0.15), (low, 0.35), (end, 0.02)]
    swing = [(begin, 0.05), (crouch, -0.85), (leave, 2.6), (leave + 0.25, 0.95)]
    swing += [(land - 0.2, 0.9), (land, 1.0), (low, 0.7), (end, 0.05)]
    flex = [(begin, 0.26), (crouch, 0.2), (leave, 0.3), (leave + 0.25, 0.8)]
    flex += [(land - 0.2, 0.7), (land, 0.5), (low, 0.4), (end, 0.26)]
    place = Jump(x=-back)
    holds: tuple[list[Foothold], list[Foothold]] = ([], [])
    leaving = {"lift": leave, "push": 0.6, "peel": 0.16, "shed": 0.02}
    for side in (0, 1):
        first = home(side, clearance=rise + 0.12, snap=1.4, **leaving)
        last = replace(_landing(side, place, land), strike=0.25)
        holds[side].extend([first, last])
    t = times(end + 0.7)
    plan = _two_footed(t, holds, height_path(t, height), lean, bend, swing, flex)
    drawn = brisk(t, leave, leave + 0.28) * (1.0 - brisk(t, land - 0.26, land))
    tuck = np.array([[0.18, side * 0.10, -0.34] for side in (1.0, -1.0)])
    plan = replace(
        plan,
        tuck=np.tile(tuck, (len(t), 1, 1)),
        tucked=np.stack([drawn, drawn], 1),
    )
    return solve(plan)
