"""Whether cleaning the feet left a motion better, by its worst frame.

A mean hides a knee that pops for one frame. So no joint, no range, no speed, no knee's
second difference and no depth may get worse than before beyond the bounds here; where
one does, the foot of that leg is left as it was for a while.

Letters: T frames, 2 legs (left, right). Joints of a leg: hip, knee, ankle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from dcc_jax.character import load_character
from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import split_qpos, to_rotation
from dcc_jax.motion.retarget.figure import figure, soles_of

CHANGE = np.radians([25.0, 25.0, 40.0])  # of hip, knee and ankle against the copy
RANGE = math.radians(10.0)  # further out of a joint's range
SPEED = math.radians(300.0)  # rad/s, faster than before
BEND = 1.2  # times the largest second difference of that knee before
BEND_SLACK = math.radians(0.5)  # which is no pop
BEND_STEP = 1.0 / 30.0  # s, between the three frames of a second difference
DEPTH = 0.01  # m, deeper in the ground
LEGS = (slice(6, 9), slice(9, 12))  # joints of the left and of the right leg
AROUND = 0.15  # s, left before and after a frame that got worse
KINDS = ("turned a joint", "left its range", "sped a joint up", "popped a knee", "sank")


@dataclass(frozen=True, eq=False)
class Judgement:
    """What cleaning made worse."""

    worse: np.ndarray  # [T, 2, kinds], by leg
    fps: float

    @property
    def fine(self) -> bool:
        """Whether nothing is worse beyond the bounds."""
        return not self.worse.any()

    def around(self) -> np.ndarray:
        """Frames [T, 2] of a leg that are worse, or near to such."""
        size = 2 * max(1, round(AROUND * self.fps)) + 1
        near = maximum_filter1d(self.worse.any(axis=2).astype(np.uint8), size, axis=0)
        return near.astype(bool)

    def reasons(self) -> str:
        """What got worse, in words."""
        found = [bool(self.worse[..., kind].any()) for kind in range(len(KINDS))]
        return ", ".join(kind for kind, on in zip(KINDS, found, strict=True) if on)


def judged(before: Clip, after: Clip) -> Judgement:
    """Compares a clip before and after its feet were cleaned."""
    turns = [to_rotation(split_qpos(clip.qpos)[1][:, 1:]) for clip in (before, after)]
    change = (turns[0].inv() * turns[1]).magnitude()
    excess = [_excess(turn.as_rotvec()) for turn in turns]
    steps = [
        clip.fps * (turn[:-1].inv() * turn[1:]).magnitude()
        for clip, turn in zip((before, after), turns, strict=True)
    ]
    steps = [np.concatenate([step, step[-1:]]) for step in steps]
    depth = [_depth(clip) for clip in (before, after)]
    worse = np.zeros((len(change), 2, len(KINDS)), bool)
    for side, leg in enumerate(LEGS):
        knee = leg.start + 1
        bends = [_bend(turn.magnitude()[:, knee], before.fps) for turn in turns]
        limit = BEND * bends[0].max() + BEND_SLACK
        worse[:, side] = np.stack(
            [
                (change[:, leg] > CHANGE).any(axis=1),
                (excess[1] - excess[0])[:, leg].max(axis=1) > RANGE,
                (steps[1] - steps[0])[:, leg].max(axis=1) > SPEED,
                bends[1] > limit,
                (depth[1] - np.maximum(depth[0], 0.0))[:, side] > DEPTH,
            ],
            axis=1,
        )
    return Judgement(worse, before.fps)


def _excess(vectors: np.ndarray) -> np.ndarray:
    """How far each joint is out of its range, [T, 12] rad."""
    character = load_character()
    over = np.maximum(vectors - character.upper, character.lower - vectors)
    return np.maximum(over, 0.0).max(axis=2)


def _bend(angle: np.ndarray, fps: float) -> np.ndarray:
    """Size of the second difference of an angle [T] in rad; zero at the ends."""
    step = max(1, round(BEND_STEP * fps))
    out = np.zeros_like(angle)
    if len(angle) > 2 * step:
        middle = angle[step:-step]
        out[step:-step] = np.abs(angle[: -2 * step] - 2.0 * middle + angle[2 * step :])
    return out


def _depth(clip: Clip) -> np.ndarray:
    """How deep in the ground each foot is, [T, 2] m."""
    return figure().radius - soles_of(clip.qpos)[..., 2].min(axis=2)
