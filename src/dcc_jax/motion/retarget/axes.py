"""Which way is up, and which way a figure stands and faces in its zero pose.

Letters: T frames. Vectors are in the axes of the source.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dcc_jax.motion.formats.skeleton import AXES
from dcc_jax.motion.retarget.anatomy import Anatomy, across, unit
from dcc_jax.motion.retarget.words import SIDES

SNAP = math.cos(math.radians(3.0))  # a heading this near to an axis is meant to be it
TILT = math.cos(math.radians(25.0))  # of the legs of a figure that stands
FLOOR = 0.2  # of a leg: so near to zero is the floor of most recordings
UPRIGHT = 0.8  # of the trunk along the vertical
TRAVEL = 1.0  # legs: who goes as far, walks
MOSTLY = 0.95  # share of the frames


def standing_axes(rest: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Rows forward, left and up of a zero pose; None where it does not stand.

    Arms may be anywhere.

    Args:
        rest: positions [3] of the joints, by body.
    """

    def middle(part: str) -> np.ndarray:
        return 0.5 * (rest[f"left_{part}"] + rest[f"right_{part}"])

    legs = unit(middle("thigh") - middle("foot"))
    trunk = unit(middle("upper_arm") - middle("thigh"))
    up = nearest_axis(legs)
    sides = [rest[f"left_{p}"] - rest[f"right_{p}"] for p in ("thigh", "upper_arm")]
    level = [across(side, up) for side in sides if np.linalg.norm(side) > 1e-9]
    each = [unit(rest[f"{s}_thigh"] - rest[f"{s}_foot"]) @ up for s in SIDES]
    left = unit(np.sum(level, axis=0)) if level else np.zeros(3)
    stands = legs @ up > TILT and trunk @ up > TILT and min(each) > 0.7
    if not stands or any(one @ left < TILT for one in level) or not left.any():
        return None
    if left @ nearest_axis(left) > SNAP:
        left = nearest_axis(left)
    return np.stack([np.cross(left, up), left, up])


def world_axes(
    figure: Anatomy, rest_axes: np.ndarray | None, given: str | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Rows of the world's axes, z up, and what to tell the user about them.

    What the caller says comes first, then what the format fixes. Else the world's up is
    that of the zero pose, however the figure lies: it is another only where the figure
    plainly stands and goes along that.
    """
    notes: tuple[str, ...] = ()
    named = given or figure.motion.up
    if named is not None:
        up = np.eye(3)[AXES.index(named) % 3] * (1.0 if AXES.index(named) < 3 else -1.0)
        if given and rest_axes is not None and up @ rest_axes[2] < 0.9:
            notes = (f"the world's up is {given}, unlike the zero pose's",)
    elif rest_axes is not None:
        up, notes = _unlike_the_zero_pose(figure, rest_axes[2])
    else:
        up = max(np.concatenate([np.eye(3), -np.eye(3)]), key=_standing_score(figure))
        notes = (f"the world's up was taken as {axis_name(up)}: say --up if it is not",)
    level = np.eye(3)[int(np.argmin(np.abs(up)))]
    if rest_axes is not None and abs(rest_axes[0] @ up) < 0.9:
        level = rest_axes[0]
    ahead = across(level, up)
    return np.stack([ahead, np.cross(up, ahead), up]), notes


def axis_name(up: np.ndarray) -> str:
    """The name of the axis nearest to a direction."""
    return AXES[int(np.argmax(np.concatenate([up, -up])))]


def nearest_axis(v: np.ndarray) -> np.ndarray:
    """The unit vector along the axis nearest to a direction."""
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(v)))
    axis[largest] = math.copysign(1.0, v[largest])
    return axis


def _unlike_the_zero_pose(
    figure: Anatomy, up: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """The world's up where the zero pose has another, and a note.

    Some programs keep a zero pose with y up and turn the root until z is up. But who
    lies on a floor is not to be stood upright.
    """
    trunk = unit(figure.middle("upper_arm") - figure.middle("thigh"))
    if (trunk @ up > 0.5).any():
        return up, ()
    other = nearest_axis(trunk.mean(axis=0))
    if not other @ up and _stands(figure, other, up):
        name = axis_name(other)
        return other, (f"the world's up is {name}, unlike the zero pose's",)
    name = axis_name(up)
    return up, (f"the figure never stands: up was taken as {name}, the zero pose's",)


def _stands(figure: Anatomy, up: np.ndarray, zero_up: np.ndarray) -> bool:
    """Whether a figure stands all the time along an axis, and on a floor.

    Who lies stands along his own trunk, too. So the floor has to be where it usually
    is, and the other axis has to have the figure in the ground or in the air; or the
    figure goes somewhere.
    """
    trunk, feet = _posture(figure, up)
    if np.mean((trunk > UPRIGHT) & (feet > UPRIGHT)) <= MOSTLY:
        return False
    way = figure.middle("thigh")
    way = np.ptp(way - np.outer(way @ up, up), axis=0).max() / figure.leg_length
    lies = -0.05 < _lowest(figure, zero_up) < 0.5
    return bool(way > TRAVEL or (abs(_lowest(figure, up)) < FLOOR and not lies))


def _lowest(figure: Anatomy, up: np.ndarray) -> float:
    """How high above zero the lowest joints are along an axis, in legs."""
    low = np.min([place @ up for place in figure.places.values()], axis=0)
    return float(np.percentile(low, 5)) / figure.leg_length


def _posture(figure: Anatomy, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far up the trunk points, and the legs, from feet to hips, [T]."""
    trunk = unit(figure.middle("upper_arm") - figure.middle("thigh")) @ up
    return trunk, unit(figure.middle("thigh") - figure.middle("foot")) @ up


def _standing_score(figure: Anatomy):
    """How plausible an axis is as the world's up where the zero pose does not say."""

    def score(up: np.ndarray) -> float:
        trunk, feet = _posture(figure, up)
        upright = float(np.mean((trunk > UPRIGHT) & (feet > UPRIGHT)))
        on_floor = 1.0 if abs(_lowest(figure, up)) < FLOOR else 0.0
        usual = {"y": 0.3, "z": 0.2}.get(axis_name(up), 0.0)
        return upright + 0.7 * on_floor + usual

    return score
