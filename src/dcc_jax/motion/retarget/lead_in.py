"""Frames that are no motion: a T-pose before it, and repeats that raise the rate."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.retarget.anatomy import Anatomy, unit
from dcc_jax.motion.retarget.words import SIDES

LONGEST = 2.0  # s, of a pose held before the motion
STILL = math.radians(2.0)  # rad a frame: who moves no faster, holds a pose
JUMP = math.radians(15.0)  # least change of the limbs where the motion begins
OUTLIER = 2.5  # times the fastest change after it
STRAIGHT = math.cos(math.radians(15.0))
WINDOW = 15  # frames after the jump it is compared with


def without_rest_pose(figure: Anatomy) -> Motion:
    """The motion without a T- or A-pose that it jumps out of.

    A file often begins with the pose its skeleton was made in, for one frame or for a
    second. Then all limbs change at once, far faster than they ever do later.
    """
    motion = figure.motion
    bones = [f"{s}_{part}" for s in SIDES for part in _PARTS]
    ways = np.stack([unit(figure.bone(bone)) for bone in bones], axis=1)
    cosine = np.clip((ways[1:] * ways[:-1]).sum(-1), -1.0, 1.0)
    steps = np.arccos(cosine)  # [T - 1, 8]
    last = min(len(steps) - 2, max(1, round(LONGEST * motion.fps)))
    for frame in range(last):
        if steps[frame].max() > JUMP:
            after = steps[frame + 1 : frame + 1 + WINDOW]
            moved = np.sort(steps[frame])[-4:].mean()
            outlier = (
                moved > OUTLIER * np.sort(after, axis=1)[:, -4:].mean(axis=1).max()
            )
            if outlier and _is_rest_pose(figure, ways[frame]):
                return _after(motion, frame + 1)
            return motion
        if steps[frame].max() > STILL:
            return motion
    return motion


def without_repeats(motion: Motion) -> Motion:
    """The motion without frames that only repeat the one before, at its true rate.

    Some programs write 30 frames a second as 60 by writing each twice: speeds are then
    zero in one frame and doubled in the next.
    """
    change = np.abs(np.diff(motion.quats, axis=0)).max(axis=(1, 2))
    moving = np.flatnonzero(change > 1e-6)
    for factor in (4, 3, 2):
        phases = moving % factor
        if len(moving) < 8 or len(moving) * factor < 0.8 * len(change):
            continue
        if len(np.unique(phases)) == 1:
            first = int(moving[0]) + 1
            kept = np.arange(first % factor, len(motion.root), factor)
            note = f"every frame is there {factor} times: taken once"
            part = replace(motion.part(kept), fps=motion.fps / factor)
            return part.noted(note)
    return motion


_PARTS = ("thigh", "shin", "upper_arm", "forearm")


def _is_rest_pose(figure: Anatomy, ways: np.ndarray) -> bool:
    """Whether limbs [8, 3] are straight, and arms and legs even on both sides."""
    left, right = ways[:4], ways[4:]
    straight = [
        float(side[a] @ side[b]) for side in (left, right) for a, b in ((0, 1), (2, 3))
    ]
    across = unit(figure.across("thigh")[0])
    mirrored = right - 2.0 * np.outer(right @ across, across)
    even = (left * mirrored).sum(axis=1)
    return bool(min(straight) > STRAIGHT and even.min() > STRAIGHT)


def _after(motion: Motion, frames: int) -> Motion:
    what = "first frame" if frames == 1 else f"first {frames} frames"
    return motion.part(slice(frames, None)).noted(f"{what} dropped: a T-pose")
