"""Is a clip plausible? What a person would see at once, found by figures.

Letters: T frames.
"""

from __future__ import annotations

import numpy as np

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import split_qpos, to_rotation
from dcc_jax.motion.retarget.figure import figure, world_of
from dcc_jax.motion.retarget.quality import Quality

RANGE = 25.0  # degrees out of its range that a joint may be for a moment
RANGE_SHARE = 0.2  # of the frames, in which it may be out by a little
LITTLE = 10.0  # degrees
DEPTH = 3.0  # cm, of a sole in the ground
SUNK = 0.10  # m, of a joint below the ground
SKATE = 8.0  # cm/s, of standing feet
TURN = 2000.0  # degrees/s, of a joint
SPEED = 12.0  # m/s, of the root
BACKWARDS = 15.0  # degrees a knee may bend forwards
TREADING = 0.5  # m/s: feet that pass under a body which stays
KNEES = (7, 10)  # of the joints


def doubts(clip: Clip, quality: Quality) -> tuple[str, ...]:
    """What is not plausible in a clip; nothing where it is good.

    Args:
        clip: any clip.
        quality: its measures.
    """
    found = [
        _ranges(quality),
        _knees(clip),
        _speeds(clip),
        _ground(clip, quality),
        _treads(clip),
    ]
    return tuple(doubt for doubt in found if doubt)


def verdict(doubts: tuple[str, ...]) -> str:
    """The line that says how far a clip can be trusted."""
    return f"verdict: check: {'; '.join(doubts)}" if doubts else "verdict: good"


def _ranges(quality: Quality) -> str:
    if quality.range_excess > RANGE or (
        quality.range_excess > LITTLE and quality.range_share > RANGE_SHARE
    ):
        return (
            f"{quality.worst_joint} is out of its range by "
            f"{quality.range_excess:.0f} degrees"
        )
    return ""


def _knees(clip: Clip) -> str:
    vectors = to_rotation(split_qpos(clip.qpos)[1][:, 1:]).as_rotvec(degrees=True)
    least = vectors[:, KNEES, 1].min()
    return (
        f"a knee bends forwards by {-least:.0f} degrees" if -least > BACKWARDS else ""
    )


def _speeds(clip: Clip) -> str:
    turns = to_rotation(split_qpos(clip.qpos)[1])
    steps = np.degrees((turns[:-1].inv() * turns[1:]).magnitude()) * clip.fps
    if steps[:, 1:].max() > TURN:
        return (
            f"a joint turns by {steps[:, 1:].max() / clip.fps:.0f} degrees in a frame"
        )
    way = np.linalg.norm(np.diff(clip.qpos[:, :3].astype(float), axis=0), axis=1)
    speed = way.max() * clip.fps
    return f"the body moves at {speed:.0f} m/s" if speed > SPEED else ""


def _ground(clip: Clip, quality: Quality) -> str:
    if quality.penetration > DEPTH:
        return f"a foot is {quality.penetration:.0f} cm in the ground"
    world = world_of(clip.qpos)
    lowest = figure().positions(clip.qpos[:, :3].astype(float), world)[..., 2].min()
    if lowest < -SUNK:
        return f"the body is {-100.0 * lowest:.0f} cm in the ground"
    if quality.skate > SKATE:
        return f"standing feet slide at {quality.skate:.0f} cm/s"
    return ""


def _treads(clip: Clip) -> str:
    """Whether the figure walks in place, as on a treadmill."""
    root = clip.qpos[:, :2].astype(float)
    world = world_of(clip.qpos)
    feet = figure().positions(clip.qpos[:, :3].astype(float), world)[:, (9, 12)]
    if len(feet) < 4:
        return ""
    speed = np.gradient(feet, 1.0 / clip.fps, axis=0)[..., :2]
    lower = feet[..., 2].argmin(axis=1)
    standing = np.take_along_axis(speed, lower[:, None, None], axis=1)[:, 0]
    size = float(np.median(np.linalg.norm(standing, axis=1)))
    if size > TREADING and np.ptp(root, axis=0).max() < size * clip.duration / 4.0:
        return f"treads in place: the standing foot moves at {size:.1f} m/s"
    return ""
