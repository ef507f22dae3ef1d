"""How the body above the feet moves: arms, trunk and pelvis of steps and gaits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from tools.author_clips.dynamics import Plan
from tools.author_clips.kinematics import Pose, about, centre_of_mass, leg_joints
from tools.author_clips.steps import Foothold, FootTrack, foot_track, quintic

RATE = 60  # Hz of the planning; the clips keep every second frame
FPS = 30
HIP_WIDTH = 0.085  # m, half the distance of the hips
STAND_PELVIS = 0.926  # m, knees softly bent


@dataclass(frozen=True)
class Style:
    """Posture and habits. Angles in rad; `per metre` is per metre of stride.

    Lean, bend and flex may change over time [T].
    """

    lean: float | np.ndarray = 0.03  # of the pelvis, forward
    bend: float | np.ndarray = 0.02  # of the spine, forward
    swing: float = 0.75  # of the arms, per metre the opposite foot is ahead
    out: float = 0.14  # arms away from the body
    flex: float | np.ndarray = 0.25  # elbows
    flex_swing: float = 0.5  # more of it, per radian of forward swing
    yaw: float = 0.18  # of the pelvis, per metre
    counter: float = 1.5  # of the chest against it
    roll: float = 0.05  # pelvis sinks on the side of the free leg
    sway: float = 0.03  # chest towards the loaded leg
    smooth: float = 0.05  # s


def keyed(t: np.ndarray, keys: list[tuple[float, float]]) -> np.ndarray:
    """Values [T] through (time, value) keys, without overshoot, softened."""
    moments, values = np.array(keys).T
    held = np.clip(t, moments[0], moments[-1])
    path = PchipInterpolator(moments, values)(held)
    return gaussian_filter1d(path, 0.03 * RATE, mode="nearest")


def height_path(t: np.ndarray, knots: list[tuple[float, ...]]) -> np.ndarray:
    """Heights [T] through knots (time, height, rate, acceleration), by quintics.

    Two knots in free fall give the exact parabola. Rate and acceleration may be left
    out, which means zero.
    """
    full = [(*knot, 0.0, 0.0)[:4] for knot in knots]
    path = np.full(len(t), full[0][1])
    path[t >= full[-1][0]] = full[-1][1]
    for begin, end in pairwise(full):
        part = (t >= begin[0]) & (t < end[0])
        span = end[0] - begin[0]
        path[part] = quintic((t[part] - begin[0]) / span, span, begin[1:], end[1:])
    return path


def times(duration: float) -> np.ndarray:
    """Planning times from 0 to `duration` inclusive."""
    return np.arange(round(duration * RATE) + 1) / RATE


def arms(
    left: np.ndarray | float,
    right: np.ndarray | float,
    out: np.ndarray | float,
    flex_left: np.ndarray | float,
    flex_right: np.ndarray | float,
    twist: float = 0.3,
) -> np.ndarray:
    """Shoulders and elbows [T, 4, 3, 3] of arms that hang and swing forward.

    Args:
        left, right: forward swing, rad.
        out: away from the body, rad; pi/2 is the T-pose.
        flex_left, flex_right: of the elbows, rad.
        twist: of the upper arms inward, rad.
    """
    joints = []
    for side, forward, flex in ((1.0, left, flex_left), (-1.0, right, flex_right)):
        forward, flex, out = np.broadcast_arrays(forward, flex, out)
        hang = about("x", -side * (np.pi / 2 - out))
        joints.append(about("y", -forward) @ hang @ about("y", twist))
        joints.append(about("z", -side * flex))
    return np.stack(joints, -3)


def gait_plan(
    t: np.ndarray,
    holds: tuple[list[Foothold], list[Foothold]],
    height: np.ndarray,
    style: Style,
    pressure: tuple[float, float] = (0.04, 0.04),
    limbs: np.ndarray | None = None,
) -> Plan:
    """Feet through their footholds and an upper body that goes with them.

    Args:
        t: times [T].
        holds: of the left and the right foot.
        height: centre of mass [T], m.
        style: see there.
        pressure: see `foot_track`.
        limbs: shoulders and elbows [T, 4, 3, 3] instead of the swinging ones.
    """
    feet = (foot_track(t, holds[0], pressure), foot_track(t, holds[1], pressure))
    yaw, ahead = heading_and_stride(feet, style.smooth)
    load = feet[0].load - feet[1].load
    side = gaussian_filter1d(load, 0.06 * RATE, mode="nearest")
    twist = style.yaw * ahead
    pelvis = (
        about("z", yaw + twist) @ about("y", np.broadcast_to(style.lean, len(t)))
    ) @ about("x", style.roll * side)
    spine = (
        about("z", -(1.0 + style.counter) * twist)
        @ about("y", np.broadcast_to(style.bend, len(t)))
        @ about("x", -(style.roll + style.sway) * side)
    )
    neck = about("z", style.counter * twist) @ about(
        "y", np.broadcast_to(-0.8 * (style.lean + style.bend), len(t))
    )
    if limbs is None:
        limbs = swinging_arms(style, style.swing * ahead)
    upper = np.concatenate([np.stack([spine, neck], 1), limbs], 1)
    return Plan(1.0 / RATE, feet, height, pelvis, upper)


def swinging_arms(style: Style, forward: np.ndarray) -> np.ndarray:
    """Arms [T, 4, 3, 3] in counter-phase, the left one `forward` [T] rad."""

    def flex(swing: np.ndarray) -> np.ndarray:
        return style.flex + style.flex_swing * np.logaddexp(0.0, 8.0 * swing) / 8.0

    return arms(forward, -forward, style.out, flex(forward), flex(-forward))


def heading_and_stride(
    feet: tuple[FootTrack, FootTrack], smooth: float
) -> tuple[np.ndarray, np.ndarray]:
    """Heading [T] of the body (rad), and how far the right foot is ahead [T] (m)."""
    yaw = 0.5 * (feet[0].yaw + feet[1].yaw)
    yaw = gaussian_filter1d(yaw, 3.0 * smooth * RATE, mode="nearest")
    gap = feet[1].ankle - feet[0].ankle
    ahead = np.cos(yaw) * gap[:, 0] + np.sin(yaw) * gap[:, 1]
    return yaw, gaussian_filter1d(ahead, smooth * RATE, mode="nearest")


@cache
def stand_height() -> float:
    """Height of the centre of mass of a relaxed stand, m."""
    root = np.array([[0.0, 0.0, STAND_PELVIS]])
    pelvis = np.eye(3)[None]
    ankles = np.array([[[-0.02, HIP_WIDTH, 0.075], [-0.02, -HIP_WIDTH, 0.075]]])
    feet = np.broadcast_to(np.eye(3), (1, 2, 3, 3))
    legs, _ = leg_joints(root, pelvis, ankles, feet, feet[..., 0])
    trunk = np.broadcast_to(np.eye(3), (1, 2, 3, 3))
    limbs = arms(0.0, 0.0, 0.14, 0.25, 0.25)[None]
    pose = Pose(root, pelvis, np.concatenate([trunk, limbs, legs], 1))
    return float(centre_of_mass(pose)[0, 2])
