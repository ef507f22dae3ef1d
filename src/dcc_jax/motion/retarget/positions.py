"""Segments from joint positions alone, where a file's rotations cannot be believed.

Programs that turn video into motion, and learned models, know where joints are and make
up rotations that take them there. What twists a bone about itself is then arbitrary.

Letters: T frames. Matrices have columns forward, left and up of our segment.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dcc_jax.motion.retarget.anatomy import (
    HINGED,
    Anatomy,
    across,
    frame,
    shortest,
    unit,
)
from dcc_jax.motion.retarget.calibrate import SOLE, along, hinge_axis
from dcc_jax.motion.retarget.words import SIDES

PELVIS_OFF = math.radians(8.0)  # of the line through the hips in the pelvis's frame
CHEST_OFF = math.radians(35.0)  # of that through the shoulders: collars move
STEADY = 0.98  # length of the mean of unit axes; below, the bone twists at random
NEARLY = 0.995  # ... and below this, where another one does
BENT = 0.03  # mean square sine of a knee or elbow from which its axis counts
UNTWISTED = 0.02  # weight of no twist against the square sine of the joint
EASE = 0.07  # s, over which twists are smoothed


def denied_by_positions(figure: Anatomy) -> tuple[bool, list[str]]:
    """Whether the trunk's rotations cannot be those of its joints, and which limbs'."""
    trunk = (
        _off(figure, "pelvis", "thigh") > PELVIS_OFF
        or _off(figure, "chest", "upper_arm") > CHEST_OFF
    )
    steady = {}
    for side in SIDES:
        for upper, lower in (HINGED[:2], HINGED[2:]):
            axis, surely = figure.hinge(f"{side}_{upper}")
            mean = surely @ figure.within(f"{side}_{upper}", axis)
            length = float(np.linalg.norm(mean)) / max(float(surely.sum()), 1e-9)
            limb = (f"{side}_{upper}", f"{side}_{lower}")
            steady[limb] = length if surely.mean() > BENT else 1.0
    limit = NEARLY if min(steady.values()) < STEADY else 0.0
    return trunk, [bone for limb, at in steady.items() if at < limit for bone in limb]


def _off(figure: Anatomy, segment: str, part: str) -> float:
    """Angle (rad, root mean square) between a line of joints and the zero pose's."""
    theirs = unit(figure.rest[f"left_{part}"] - figure.rest[f"right_{part}"])
    lines = figure.within(segment, unit(figure.across(part)))
    angles = np.arccos(np.clip(lines @ theirs, -1.0, 1.0))
    return float(np.sqrt((angles**2).mean()))


def from_positions(
    figure: Anatomy,
    world: dict[str, Rotation],
    rest_axes: np.ndarray | None,
    trunk: bool,
    limbs: list[str],
) -> dict[str, Rotation]:
    """World rotations [T] of the segments, some of them from joint positions.

    Args:
        figure: the source.
        world: the rotations as they come from the file's.
        rest_axes: rows forward, left and up of the zero pose, if it stands.
        trunk: whether pelvis, chest and head are to be found from positions, and with
            them all limbs.
        limbs: the segments of the limbs that are.
    """
    world = dict(world)
    if trunk:
        world.update(_trunk(figure, rest_axes))
        limbs = [f"{side}_{part}" for side in SIDES for part in HINGED]
    for segment in limbs:
        side, _, part = segment.partition("_")
        world[segment] = _twisted(figure, segment, world)
        if part == "shin":
            world[f"{side}_foot"] = _foot(figure, side, world, rest_axes)
    return world


def _trunk(figure: Anatomy, rest_axes: np.ndarray | None) -> dict[str, Rotation]:
    """Pelvis, chest and head."""
    hips, shoulders = figure.middle("thigh"), figure.middle("upper_arm")
    chest = figure.places["chest"]
    lines = {
        "pelvis": (chest - hips, figure.across("thigh")),
        "chest": (shoulders - chest, figure.across("upper_arm")),
    }
    rest = figure.rest
    middles = {
        part: 0.5 * (rest[f"left_{part}"] + rest[f"right_{part}"])
        for part in ("thigh", "upper_arm")
    }
    rest_lines = {
        "pelvis": (rest["chest"] - middles["thigh"], "thigh"),
        "chest": (middles["upper_arm"] - rest["chest"], "upper_arm"),
    }
    out = {}
    for segment, (up, left) in lines.items():
        frames = frame(up, left)
        if rest_axes is not None:
            rest_up, part = rest_lines[segment]
            rest_left = rest[f"left_{part}"] - rest[f"right_{part}"]
            frames = frames @ frame(rest_up, rest_left).T @ rest_axes.T
        out[segment] = Rotation.from_matrix(frames)
    out["head"] = _head(figure, out["chest"], rest_axes)
    return out


def _head(figure: Anatomy, chest: Rotation, rest_axes: np.ndarray | None) -> Rotation:
    """The head: up along its bone, its face where the chest faces."""
    upward = np.array([0.0, 0.0, 1.0]) if rest_axes is None else rest_axes[2]
    left = chest.apply([0.0, 1.0, 0.0])
    return Rotation.from_matrix(frame(figure.turns["head"].apply(upward), left))


def _twisted(figure: Anatomy, segment: str, world: dict[str, Rotation]) -> Rotation:
    """A bone along its joints, turned about itself until knee or elbow is a hinge.

    Where the joint is straight its axis says nothing: there the bone takes the shortest
    way from its parent.
    """
    side, _, part = segment.partition("_")
    upper = f"{side}_{'thigh' if part in HINGED[:2] else 'upper_arm'}"
    trunk = "pelvis" if part in HINGED[:2] else "chest"
    parent = world[trunk if segment == upper else upper]
    bone = figure.bone(segment)
    if not bone.any():
        return parent
    swing = shortest(parent.apply(along(segment)), bone) * parent
    plain = swing.apply(hinge_axis(segment))
    axis, surely = figure.hinge(segment)
    bone = unit(bone)
    axis = across(axis, bone)
    cosine = (plain * axis).sum(axis=1)
    sine = (np.cross(plain, axis) * bone).sum(axis=1)
    seen = surely * np.exp(1j * np.arctan2(sine, cosine))
    width = max(EASE * figure.motion.fps, 1e-3)
    eased = gaussian_filter1d(seen.real, width) + 1j * gaussian_filter1d(
        seen.imag, width
    )
    twist = np.angle(eased + UNTWISTED)
    return Rotation.from_rotvec(bone * twist[:, None]) * swing


def _foot(
    figure: Anatomy,
    side: str,
    world: dict[str, Rotation],
    rest_axes: np.ndarray | None,
) -> Rotation:
    """A foot along its toes, its sole level if it is in the zero pose."""
    left = world[f"{side}_shin"].apply([0.0, 1.0, 0.0])
    toes = figure.bone(f"{side}_foot")
    if not toes.any():
        return world[f"{side}_shin"]
    fall = SOLE
    if rest_axes is not None:
        bone = figure.rest[f"{side}_toe"] - figure.rest[f"{side}_foot"]
        fall = -math.asin(float(np.clip(unit(bone) @ rest_axes[2], -1.0, 1.0)))
    toes = unit(toes)
    left = across(left, toes)
    ahead = Rotation.from_rotvec(-fall * left).apply(toes)
    return Rotation.from_matrix(frame(np.cross(ahead, left), left))
