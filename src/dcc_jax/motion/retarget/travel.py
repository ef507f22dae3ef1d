"""Where a figure goes, for files that do not say: its standing foot stays.

Letters: T frames.
"""

from __future__ import annotations

import numpy as np

from dcc_jax.motion.frames import to_rotation
from dcc_jax.motion.retarget.figure import FEET, figure

SWITCH = 0.015  # m, that the other foot must be lower to be stood on
STILL = 1e-4  # legs: who moves less, stays where it is


def root_stays(root: np.ndarray, leg: float) -> bool:
    """Whether the pelvis [T, 3] never moves, on legs so long."""
    return bool(np.ptp(root, axis=0).max() < STILL * leg)


def walked_path(world: np.ndarray) -> np.ndarray:
    """The root's path [T, 3] on which feet stand still and touch the ground.

    In every frame the figure stands on its lower foot. Between two frames the point of
    that foot's sole which is the lowest in both does not move. There is no flight.

    Args:
        world: world rotations [T, 13, 4] of the segments.
    """
    body = figure()
    positions = body.positions(np.zeros((len(world), 3)), world)
    feet = list(FEET)
    soles = body.sole_centres(positions[:, feet], world[:, feet])
    height = soles[..., 2].min(axis=2)
    standing = _standing_foot(height)
    path = np.zeros((len(world), 3))
    for t in range(1, len(world)):
        foot = standing[t]
        both = soles[t - 1 : t + 1, foot]
        point = both[..., 2].max(axis=0).argmin()
        step = both[1, point] - both[0, point]
        turn = (
            to_rotation(world[t, feet[foot]])
            * to_rotation(world[t - 1, feet[foot]]).inv()
        )
        rolled = np.cross(turn.as_rotvec(), [0.0, 0.0, body.radius])
        path[t] = path[t - 1] - step + rolled
    path[:, 2] = body.radius - height.min(axis=1)
    return path


def _standing_foot(height: np.ndarray) -> np.ndarray:
    """Which foot is stood on [T], of the heights [T, 2] of both soles."""
    foot, out = int(height[0].argmin()), []
    for low in height:
        if low[1 - foot] < low[foot] - SWITCH:
            foot = 1 - foot
        out.append(foot)
    return np.array(out)
