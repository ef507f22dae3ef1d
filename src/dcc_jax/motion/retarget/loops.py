"""Loops: where to cut a motion so that it repeats, and how to close the seam."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.clip import Clip, crop, velocities
from dcc_jax.motion.frames import (
    join_qpos,
    moved,
    rotations,
    seam_of,
    split_qpos,
    to_quats,
    to_rotation,
)

SHORTEST = 0.4  # s, of a period
COMPARED = 1500  # frames that are all compared with each other
CANDIDATES = 20  # of those cuts that are looked at closely
BRIEFEST = 0.2  # s, of a period that a file claims
WORST_SEAM = math.radians(30.0)  # a joint may be off by this before closing
SPEED_WEIGHT = 0.1  # s, of differences in velocity against those in pose


def tiled(clip: Clip, laps: int) -> Clip:
    """A loop with `laps` more periods before it and after it; no longer a loop."""
    if not laps:
        return clip
    qpos = clip.qpos.astype(float)
    turn, shift = seam_of(qpos)
    back = -Rotation.from_euler("z", -turn).apply(shift)
    parts, before, after = [qpos], qpos, qpos
    for _ in range(laps):
        before = moved(before, -turn, back)
        after = moved(after, turn, shift)
        parts = [before[:-1], *parts, after[1:]]
    frames = join_qpos(*split_qpos(np.concatenate(parts)))
    return replace(clip, qpos=frames, loop=False, phase=None)


def closed(qpos: np.ndarray) -> np.ndarray:
    """Frames [T, 55] whose last is exactly the first, moved: the gap is spread out."""
    turn, shift = seam_of(qpos)
    wanted = moved(qpos[:1].astype(float), turn, shift)
    turns = rotations(qpos)
    gap = (turns[-1].inv() * rotations(wanted)[0]).as_rotvec()
    share = np.linspace(-0.5, 0.5, len(qpos))
    quats = turns * Rotation.from_rotvec(share[:, None, None] * gap)
    rise = wanted[0, 2] - qpos[-1, 2]
    position = qpos[:, :3] + share[:, None] * [0.0, 0.0, rise]
    out = join_qpos(position, to_quats(quats)).astype(float)
    turn, shift = seam_of(out)
    out[-1:] = moved(out[:1], turn, shift)
    return join_qpos(*split_qpos(out))


def looped(clip: Clip) -> tuple[Clip, str]:
    """A clip that is said to repeat as a loop, and what to tell the user about it.

    Such claims are often loose: the gap between the ends is spread over the period, and
    where it is too wide the clip stays as it is.
    """
    if clip.duration < BRIEFEST:
        return replace(clip, loop=False), f"no loop: it lasts {clip.duration:.3f} s"
    gap = math.degrees(_gap(clip.qpos))
    if gap > math.degrees(WORST_SEAM):
        return replace(
            clip, loop=False
        ), f"no loop: its ends differ by {gap:.0f} degrees"
    closing = f"closed a loop whose ends differed by {gap:.0f} degrees"
    return replace(
        clip, qpos=closed(clip.qpos), loop=True
    ), closing if gap > 2.0 else ""


def _gap(qpos: np.ndarray) -> float:
    """Largest angle (rad) of a joint between the last frame and the moved first."""
    turn, shift = seam_of(qpos)
    ends = np.stack([moved(qpos[:1].astype(float), turn, shift)[0], qpos[-1]])
    turns = rotations(ends)
    return float((turns[0].inv() * turns[1]).magnitude().max())


def as_loop(clip: Clip) -> Clip:
    """The stretch of a clip that repeats best, closed to a loop.

    Raises:
        ValueError: no stretch comes back to where it began.
    """
    shortest = math.ceil(SHORTEST * clip.fps)
    if len(clip.qpos) <= shortest:
        raise ValueError(f"a loop takes {SHORTEST} s, this lasts {clip.duration:.2f} s")
    first, last = _best_cut(_features(clip), shortest)
    part = crop(clip, first / clip.fps, last / clip.fps)
    gap = _gap(part.qpos)
    if gap > WORST_SEAM:
        raise ValueError(
            f"no loop in it: the best seam is off by {math.degrees(gap):.0f} degrees"
        )
    return replace(part, qpos=closed(part.qpos), loop=True)


def _best_cut(features: np.ndarray, shortest: int) -> tuple[int, int]:
    """The two frames of [T, F] features that are most alike, some frames apart.

    Of a long clip every n-th frame is compared with all others first, then the frames
    about the best of these: time and memory grow with the clip's length alone.
    """
    stride = max(1, math.ceil(len(features) / COMPARED))
    coarse = features[::stride]
    squares = (coarse**2).sum(axis=1)
    apart = squares[:, None] + squares - 2.0 * coarse @ coarse.T
    far = np.arange(len(coarse))
    gap = max(1, math.ceil(shortest / stride))
    apart[far[None] - far[:, None] < gap] = np.inf
    count = min(CANDIDATES, apart.size - 1)
    best = np.argpartition(apart, count, axis=None)[:count]
    found = (np.inf, 0, shortest)
    for one, two in zip(*np.unravel_index(best, apart.shape), strict=True):
        starts = np.arange(max(0, (one - 1) * stride), (one + 1) * stride + 1)
        stops = np.arange(max(0, (two - 1) * stride), (two + 1) * stride + 1)
        starts, stops = (at[at < len(features)] for at in (starts, stops))
        near = ((features[starts, None] - features[None, stops]) ** 2).sum(-1)
        near[stops[None] - starts[:, None] < shortest] = np.inf
        at = np.unravel_index(near.argmin(), near.shape)
        found = min(found, (near[at], int(starts[at[0]]), int(stops[at[1]])))
    return found[1], found[2]


def _features(clip: Clip) -> np.ndarray:
    """Pose and velocity of every frame without place and heading, [T, F]."""
    root = to_rotation(clip.qpos[:, 3:7])
    joints = rotations(clip.qpos).as_matrix()[:, 1:].reshape(len(clip.qpos), -1)
    up = root.inv().apply([0.0, 0.0, 1.0])
    speed = velocities(clip)
    local = root.inv().apply(speed[:, :3])
    return np.concatenate(
        [
            joints,
            2.0 * up,
            clip.qpos[:, 2:3],
            SPEED_WEIGHT * local,
            SPEED_WEIGHT * speed[:, 3:],
        ],
        axis=1,
    )
