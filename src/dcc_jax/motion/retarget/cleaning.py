"""Foot cleaning: the least change after which standing feet neither slide nor sink.

Copying rotations to another body leaves its feet sliding and off the ground. What is
sought is a correction of the root's path and of both feet, over all frames at once: a
least-squares problem whose matrix is banded, solved anew about its last solution until
it is settled (Gauss-Newton, with the inequalities as an active set).

Letters: T frames; 15 unknowns a frame: the root's shift, and shift and turn (a rotation
vector in the world) of the left and of the right foot.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.retarget.banded import Equations
from dcc_jax.motion.retarget.figure import (
    FEET,
    THIGHS,
    Figure,
    figure,
    qpos_of,
    world_of,
)
from dcc_jax.motion.retarget.foot_terms import (
    FOOT,
    ROOT,
    UNKNOWNS,
    Pose,
    heights,
    hold,
    keep_knees,
    keep_length,
    least_heights,
    pivoting,
    stay_close,
    stop,
    stretches,
)
from dcc_jax.motion.retarget.legs import reach_feet

ROUNDS = 8
WINDOW = 1500  # frames that are corrected at once
FADE = 1.5  # s, that two windows have in common


def clean_feet(
    clip: Clip, contacts: np.ndarray, left: np.ndarray | None = None
) -> Clip:
    """The clip with feet that stand where they are said to.

    Args:
        clip: on level ground at z = 0.
        contacts: [T, 2, 2], which part (heel, toe) of which foot stands.
        left: [T, 2], how far a foot is left alone: 1, it need not stand; 2, it may
            even be below the ground.
    """
    left = np.zeros(contacts.shape[:2], int) if left is None else left
    contacts, free = contacts & (left < 1)[..., None], left > 1
    body = figure()
    world = world_of(clip.qpos)
    root = clip.qpos[:, :3].astype(float)
    positions = body.positions(root, world)
    start = Pose(root, positions[:, list(THIGHS)], positions[:, list(FEET)], world)
    now = start.changed(_correction(body, start, contacts, free, clip.fps))
    reached = reach_feet(body, now.root, world, now.ankles, now.feet)
    return replace(clip, qpos=qpos_of(now.root, reached))


def _correction(
    body: Figure, start: Pose, contacts: np.ndarray, free: np.ndarray, fps: float
) -> np.ndarray:
    """The correction [T, 15], in windows that fade into each other.

    What stands at one time does not matter to another, so that memory need not grow
    with the length of a recording.
    """
    frames, fade = len(start.root), round(FADE * fps)
    total, weights = np.zeros((frames, UNKNOWNS)), np.zeros((frames, 1))
    for first in range(0, max(1, frames - fade), WINDOW - fade):
        part = slice(first, min(first + WINDOW, frames))
        change = _settled(body, start.part(part), contacts[part], free[part], fps)
        weight = np.ones(len(change))
        if first:
            weight[:fade] = (np.arange(fade) + 0.5)[: len(weight)] / fade
        if part.stop < frames:
            weight[-fade:] = 1.0 - (np.arange(fade) + 0.5) / fade
        total[part] += weight[:, None] * change
        weights[part] += weight[:, None]
    return total / weights


def _settled(
    body: Figure, start: Pose, contacts: np.ndarray, free: np.ndarray, fps: float
) -> np.ndarray:
    """The correction [T, 15] after as many rounds as it takes.

    An inequality acts from when it is broken for as long as it pushes, which the last
    linear solution tells; what the pose itself tells would switch it on and off.
    """
    change = np.zeros((len(start.root), UNKNOWNS))
    standing = np.repeat(contacts, 2, axis=2)
    fixed = contacts & ~pivoting(body, start, fps)
    least = least_heights(body, start, standing, fps)
    floored = np.zeros(standing.shape, bool)  # points held up by the ground
    taut = np.zeros(standing.shape[:2], bool)  # legs held back by their length
    for _ in range(ROUNDS):
        now = start.changed(change)
        low, moves = heights(body, now)
        excess, along = stretches(body, now)
        floored |= (low < least) & ~free[..., None]
        taut |= excess > 0.0
        equations = Equations(width=3 * UNKNOWNS)
        stay_close(equations, change, fps)
        hold(equations, low, least, moves, standing | floored)
        stop(equations, body, now, fixed, moves, fps)
        keep_length(equations, len(change), excess, along, taut)
        keep_knees(equations, body, start, now, along, fps)
        step = equations.solve(change.size).reshape(change.shape)
        change = change + step
        feet = np.stack([step[:, part] for part in FOOT], axis=1)
        floored &= low + np.einsum("tfki,tfi->tfk", moves[..., 2, :], feet) < least
        apart = feet[..., :3] - step[:, None, ROOT]
        taut &= excess + np.einsum("tfi,tfi->tf", along, apart) > 0.0
    return change
