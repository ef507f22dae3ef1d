"""How our segments lie in the zero pose of a foreign figure: constant rotations.

Where the zero pose stands, it says all. Where it does not (bones along one axis, as
game engines export), the joint positions of the motion say where a bone points, knees
and elbows about which axis it flexes, hips and shoulders which way the trunk faces.

Letters: T frames. Matrices have columns forward, left and up of our segment.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.retarget.anatomy import (
    ENDS,
    HINGED,
    Anatomy,
    across,
    frame,
    shortest,
    unit,
)
from dcc_jax.motion.retarget.figure import SEGMENTS
from dcc_jax.motion.retarget.words import SIDES

SPREAD = math.radians(12.0)  # legs spread further have feet square to them
BENT = (
    0.03  # mean square sine of a knee or elbow from which its axis counts: 10 degrees
)
STEADY = 0.9  # length of the mean of unit axes that are one axis
OTHER = math.cos(
    math.radians(50.0)
)  # a zero pose whose hinges are off by more is wrong
STRAIGHT = math.cos(math.radians(20.0))  # of a spine in the zero pose
SOLE = math.radians(25.0)  # by which the line from ankle to toes falls, standing


def along(segment: str) -> np.ndarray:
    """The direction [3] of a limb's segment in our zero pose, a T-pose."""
    side, _, part = segment.partition("_")
    if part in ("thigh", "shin"):
        return np.array([0.0, 0.0, -1.0])
    return np.array([0.0, 1.0 if side == "left" else -1.0, 0.0])


def hinge_axis(segment: str) -> np.ndarray:
    """The axis [3] about which knee or elbow flexes in our zero pose."""
    side, _, part = segment.partition("_")
    if part in ("thigh", "shin"):
        return np.array([0.0, 1.0, 0.0])
    return np.array([0.0, 0.0, -1.0 if side == "left" else 1.0])


def calibrated(
    figure: Anatomy, rest_axes: np.ndarray | None, up: np.ndarray
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Matrix [3, 3] of each segment in the zero pose, and what to tell the user.

    Args:
        figure: the source.
        rest_axes: rows forward, left and up of its zero pose, if that stands.
        up: the world's up.
    """
    if rest_axes is None:
        note = "the zero pose does not stand: bones were found from the motion"
        return from_motion(figure, up), (note,)
    frames = from_rest(figure, rest_axes)
    wrong = [s for s in SEGMENTS if s[-5:] != "_foot" and _denied(figure, s, frames)]
    if not wrong:
        return frames, ()
    better = from_motion(figure, up, frames)
    limbs = {
        segment
        for side in SIDES
        for pair in (HINGED[:2], HINGED[2:])
        for segment in [f"{side}_{part}" for part in pair]
        if any(f"{side}_{part}" in wrong for part in pair)
    }
    note = f"the zero pose is twisted in {', '.join(sorted(limbs))}: not used there"
    return {**frames, **{segment: better[segment] for segment in limbs}}, (note,)


def from_rest(figure: Anatomy, rest_axes: np.ndarray) -> dict[str, np.ndarray]:
    """The matrices by a zero pose that stands.

    Limbs turn from our zero pose to theirs by the shortest way.
    """
    frames = {segment: rest_axes.T for segment in SEGMENTS}
    for side in SIDES:
        for part in HINGED:
            segment = f"{side}_{part}"
            theirs = rest_axes @ _rest_bone(figure, segment)
            if theirs.any():
                turn = shortest(along(segment), theirs)
                frames[segment] = rest_axes.T @ turn.as_matrix()
            elif part == "forearm":
                frames[segment] = frames[f"{side}_upper_arm"]
        leg = rest_axes @ (figure.rest[f"{side}_foot"] - figure.rest[f"{side}_thigh"])
        spread = math.atan2(leg[1], -leg[2])
        if abs(spread) > SPREAD:
            square = Rotation.from_euler("x", spread).as_matrix()
            frames[f"{side}_foot"] = rest_axes.T @ square
    return frames


def _rest_bone(figure: Anatomy, segment: str) -> np.ndarray:
    end = figure.rest.get(ENDS[segment])
    return np.zeros(3) if end is None else unit(end - figure.rest[segment])


def _mean_hinge(figure: Anatomy, segment: str) -> np.ndarray | None:
    """The axis [3] of knee or elbow in a segment's zero pose, if the motion tells."""
    axis, surely = figure.hinge(segment)
    if surely.mean() < BENT:
        return None
    mean = surely @ figure.within(segment, axis) / surely.sum()
    return unit(mean) if np.linalg.norm(mean) > STEADY else None


def _denied(figure: Anatomy, segment: str, frames: dict[str, np.ndarray]) -> bool:
    """Whether knee or elbow flexes about quite another axis than the zero pose says."""
    if segment.partition("_")[2] not in HINGED:
        return False
    hinge = _mean_hinge(figure, segment)
    return hinge is not None and bool(
        hinge @ frames[segment] @ hinge_axis(segment) < OTHER
    )


def from_motion(
    figure: Anatomy, up: np.ndarray, trunk: dict[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """The matrices by the joint positions of the motion.

    Args:
        figure: the source.
        up: the world's up.
        trunk: matrices of pelvis, chest and head, if they are known.
    """
    frames = dict(trunk or _trunk(figure))
    for side in SIDES:
        for part in HINGED:
            segment = f"{side}_{part}"
            frames[segment] = _limb(figure, segment, frames)
        frames[f"{side}_foot"] = _foot(figure, side, frames, up)
    return frames


def _trunk(figure: Anatomy) -> dict[str, np.ndarray]:
    """Pelvis, chest and head: left from hips and shoulders, up along the spine."""
    rising = figure.middle("upper_arm") - figure.middle("thigh")
    frames = {}
    straight = _straight_spine(figure)
    for segment, part in (("pelvis", "thigh"), ("chest", "upper_arm")):
        upward = figure.within(segment, unit(rising)).mean(axis=0)
        upward = upward if straight is None else straight
        left = figure.within(segment, unit(figure.across(part))).mean(axis=0)
        frames[segment] = frame(upward, left)
    chest = figure.turns["chest"]
    left = figure.within("head", chest.apply(frames["chest"][:, 1])).mean(axis=0)
    upward = figure.within("head", chest.apply(frames["chest"][:, 2])).mean(axis=0)
    frames["head"] = frame(_head_bone(figure, upward), left)
    return frames


def _straight_spine(figure: Anatomy) -> np.ndarray | None:
    """The direction of a spine that is straight in the zero pose; None if it is not."""
    rest = figure.rest
    hips = 0.5 * (rest["left_thigh"] + rest["right_thigh"])
    lower, upper = rest["chest"] - hips, rest["head"] - rest["chest"]
    if unit(lower) @ unit(upper) < STRAIGHT:
        return None
    return unit(rest["head"] - hips)


def _head_bone(figure: Anatomy, otherwise: np.ndarray) -> np.ndarray:
    """From the head's joint to its top in the zero pose, if that is plain."""
    node = figure.bodies["head"]
    children = [k for k, p in enumerate(figure.motion.parents) if p == node]
    bones = [figure.motion.offsets[child] for child in children]
    if len(bones) == 1 and unit(bones[0]) @ unit(otherwise) > 0.8:
        return bones[0]
    return otherwise


def _limb(figure: Anatomy, segment: str, frames: dict[str, np.ndarray]) -> np.ndarray:
    """A bone's direction from its joints, its twist from the hinge or its parent."""
    bone = figure.within(segment, unit(figure.bone(segment))).mean(axis=0)
    side, _, part = segment.partition("_")
    upper = f"{side}_{'thigh' if part in HINGED[:2] else 'upper_arm'}"
    if not bone.any():
        return frames[upper]
    axis = _mean_hinge(figure, segment)
    if axis is None:
        above = "pelvis" if part == "thigh" else "chest"
        above = above if segment == upper else upper
        world = figure.turns[above] * Rotation.from_matrix(frames[above])
        swing = shortest(world.apply(along(segment)), figure.bone(segment))
        axis = figure.within(
            segment, swing.apply(world.apply(hinge_axis(segment)))
        ).mean(axis=0)
    ours, own = along(segment), hinge_axis(segment)
    theirs = unit(bone)
    hinge = across(axis, theirs)
    basis = np.stack([theirs, hinge, np.cross(theirs, hinge)], axis=1)
    return basis @ np.stack([ours, own, np.cross(ours, own)], axis=1).T


def _foot(
    figure: Anatomy, side: str, frames: dict[str, np.ndarray], up: np.ndarray
) -> np.ndarray:
    """A foot: ahead along the toes, its sole level where it stands."""
    foot, shin = f"{side}_foot", f"{side}_shin"
    world = figure.turns[shin] * Rotation.from_matrix(frames[shin])
    left = figure.within(foot, world.apply([0.0, 1.0, 0.0])).mean(axis=0)
    toes = figure.within(foot, unit(figure.bone(foot))).mean(axis=0)
    if not toes.any():
        return frame(
            figure.within(foot, world.apply([0.0, 0.0, 1.0])).mean(axis=0), left
        )
    toes = unit(toes)
    pitch = Rotation.from_rotvec(-_fall(figure, foot, up) * across(left, toes))
    ahead = pitch.apply(toes)
    return frame(np.cross(ahead, across(left, ahead)), left)


def _fall(figure: Anatomy, foot: str, up: np.ndarray) -> float:
    """By which angle the line from ankle to toes falls while the foot stands, rad."""
    toe = figure.places[ENDS[foot]]
    if len(toe) < 3:
        return SOLE
    speed = np.linalg.norm(np.gradient(toe, axis=0), axis=1) * figure.motion.fps
    speed += np.linalg.norm(np.gradient(figure.places[foot], axis=0), axis=1)
    height = toe @ up
    slow = speed < 0.4 * figure.leg_length
    slow &= height < np.percentile(height, 20) + 0.05 * figure.leg_length
    fall = -np.arcsin(np.clip(unit(figure.bone(foot)) @ up, -1.0, 1.0))
    if np.count_nonzero(slow) < 3:
        return SOLE
    found = float(np.median(fall[slow]))
    return found if 0.0 <= found <= math.radians(60.0) else SOLE
