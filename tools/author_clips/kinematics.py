"""Whole-body kinematics for authoring: poses over time, mass, momentum, leg IK.

Offline numpy in double precision over a whole clip at once. Letters: T frames, 12
joints and 15 bodies in the order of `character.py`. Rotations are matrices here; they
become quaternions only when a clip leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.character import JOINTS, load_character

THIGH, SHIN = 0.4, 0.4  # m, assets/character.xml
HIPS = np.array([[0.0, 0.085, -0.06], [0.0, -0.085, -0.06]])  # m, in the pelvis
UPPER_ARM, PALM = 0.28, 0.325  # m, shoulder to elbow, elbow to middle of the hand
SPINE, NECK, LEFT_SHOULDER, LEFT_ELBOW, RIGHT_SHOULDER, RIGHT_ELBOW = range(6)
LEGS = ((6, 7, 8), (9, 10, 11))  # hip, knee, ankle of the left and the right leg
PELVIS, CHEST = 0, 1
ANKLE_HEIGHT = 0.075  # m above the ground of a flat foot
UP = np.array([0.0, 0.0, 1.0])


def rotation(vector: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] of rotation vectors [..., 3] in rad."""
    vector = np.asarray(vector, float)
    flat = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vector.shape[:-1], 3, 3)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] of matrices [..., 3, 3], the short way round."""
    flat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*matrix.shape[:-2], 3)


def about(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """Matrices [..., 3, 3] of rotations by `angle` [...] about x, y or z."""
    angle = np.asarray(angle, float)
    return rotation(angle[..., None] * np.eye(3)["xyz".index(axis)])


def apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] rotated by matrices [..., 3, 3]."""
    return np.einsum("...ij,...j->...i", matrix, vector)


def unit(vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length one."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Body:
    """Mass and geometry of the 15 bodies, read from the character's model."""

    parent: np.ndarray  # [15], -1 for the pelvis
    joint: np.ndarray  # [15] index of the joint that moves the body, -1 for none
    offset: np.ndarray  # [15, 3] m, origin in the parent's frame
    mass: np.ndarray  # [15] kg
    com: np.ndarray  # [15, 3] m, in the body's frame
    inertia: np.ndarray  # [15, 3, 3] kg m^2, about the body's centre of mass


@cache
def body() -> Body:
    """The tables of the standard character."""
    model = load_character().spec().compile()
    frames = Rotation.from_quat(model.body_iquat[1:], scalar_first=True).as_matrix()
    diagonal = model.body_inertia[1:, :, None] * np.eye(3)
    owner = {
        int(model.jnt_bodyid[mujoco_id]) - 1: mujoco_id - 1
        for mujoco_id in range(1, model.njnt)
    }
    assert [model.joint(i + 1).name for i in range(12)] == [j.name for j in JOINTS]
    return Body(
        parent=model.body_parentid[1:] - 1,
        joint=np.array([owner.get(i, -1) for i in range(model.nbody - 1)]),
        offset=model.body_pos[1:].copy(),
        mass=model.body_mass[1:].copy(),
        com=model.body_ipos[1:].copy(),
        inertia=frames @ diagonal @ frames.transpose(0, 2, 1),
    )


@dataclass(frozen=True, eq=False)
class Pose:
    """A clip's coordinates as matrices."""

    root: np.ndarray  # [T, 3] m
    pelvis: np.ndarray  # [T, 3, 3] pelvis to world
    joints: np.ndarray  # [T, 12, 3, 3] child to parent

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """World origins [T, 15, 3] and orientations [T, 15, 3, 3] of the bodies."""
        table = body()
        origins, rotations = [self.root], [self.pelvis]
        for index in range(1, len(table.parent)):
            parent, joint = table.parent[index], table.joint[index]
            offset = apply(rotations[parent], table.offset[index])
            origins.append(origins[parent] + offset)
            turn = self.joints[:, joint] if joint >= 0 else np.eye(3)
            rotations.append(rotations[parent] @ turn)
        return np.stack(origins, 1), np.stack(rotations, 1)

    def qpos(self) -> np.ndarray:
        """MuJoCo coordinates [T, 55] with quaternions continuous in sign."""
        quats = np.concatenate([self.pelvis[:, None], self.joints], axis=1)
        flat = Rotation.from_matrix(quats.reshape(-1, 3, 3)).as_quat(scalar_first=True)
        flat = flat.reshape(*quats.shape[:2], 4)
        flat[0] *= np.where(flat[0, :, :1] < 0.0, -1.0, 1.0)
        same = np.sum(flat[1:] * flat[:-1], axis=-1, keepdims=True) >= 0.0
        flat[1:] *= np.cumprod(np.where(same, 1.0, -1.0), axis=0)
        return np.concatenate([self.root, flat.reshape(len(flat), -1)], axis=1)


def centre_of_mass(pose: Pose) -> np.ndarray:
    """[T, 3] m."""
    origins, rotations = pose.frames()
    table = body()
    centres = origins + apply(rotations, table.com)
    return np.einsum("b,tbi->ti", table.mass, centres) / table.mass.sum()


@dataclass(frozen=True, eq=False)
class Momentum:
    """Motion of the whole body about its centre of mass."""

    com: np.ndarray  # [T, 3] m
    angular: np.ndarray  # [T, 3] kg m^2/s, world axes
    inertia: np.ndarray  # [T, 3, 3] kg m^2, world axes


def momentum(pose: Pose, dt: float) -> Momentum:
    """Centre of mass, angular momentum and inertia of every frame."""
    origins, rotations = pose.frames()
    table = body()
    centres = origins + apply(rotations, table.com)
    com = np.einsum("b,tbi->ti", table.mass, centres) / table.mass.sum()
    arm = centres - com[:, None]
    velocity = np.gradient(arm, dt, axis=0)
    inertia_w = rotations @ table.inertia @ rotations.swapaxes(-1, -2)
    spin = apply(inertia_w, angular_velocity(rotations, dt))
    orbit = table.mass[:, None] * np.cross(arm, velocity)
    square = np.einsum("tbi,tbi->tb", arm, arm)[..., None, None] * np.eye(3)
    steiner = square - arm[..., :, None] * arm[..., None, :]
    inertia = inertia_w + table.mass[:, None, None] * steiner
    return Momentum(com, (spin + orbit).sum(1), inertia.sum(1))


def angular_velocity(rotations: np.ndarray, dt: float) -> np.ndarray:
    """World angular velocity [T, ..., 3] of matrices [T, ..., 3, 3] over time."""
    back = np.concatenate([rotations[:1], rotations[:-1]])
    ahead = np.concatenate([rotations[1:], rotations[-1:]])
    steps = np.full(len(rotations), 2.0)
    steps[[0, -1]] = 1.0
    turn = rotation_vector(ahead @ back.swapaxes(-1, -2))
    return turn / (dt * steps.reshape(-1, *[1] * (turn.ndim - 1)))


def leg_joints(
    root: np.ndarray,
    pelvis: np.ndarray,
    ankles: np.ndarray,
    feet: np.ndarray,
    forward: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Analytic inverse kinematics of both legs.

    Args:
        root: pelvis origin [T, 3].
        pelvis: its orientation [T, 3, 3].
        ankles: where the ankles are to be [T, 2, 3].
        feet: orientation of the feet [T, 2, 3, 3].
        forward: where the knees point [T, 2, 3], world axes.

    Returns:
        hip, knee and ankle of the left and the right leg [T, 6, 3, 3], and the
        distance from hip to ankle [T, 2] in m, which may exceed the legs' reach.
    """
    table = body()
    joints, distances = [], []
    for side, (hip, _, _) in enumerate(LEGS):
        offset = table.offset[int(np.flatnonzero(table.joint == hip)[0])]
        to_ankle = ankles[:, side] - root - apply(pelvis, offset)
        distances.append(np.linalg.norm(to_ankle, axis=-1))
        thigh, shin = _two_bones(to_ankle, forward[:, side], THIGH, SHIN)
        joints += [
            pelvis.swapaxes(-1, -2) @ thigh,
            thigh.swapaxes(-1, -2) @ shin,
            shin.swapaxes(-1, -2) @ feet[:, side],
        ]
    return np.stack(joints, 1), np.stack(distances, 1)


def _two_bones(
    target: np.ndarray, forward: np.ndarray, upper: float, lower: float
) -> tuple[np.ndarray, np.ndarray]:
    """World frames of two bones along -z, bending about +y with the joint `forward`."""
    limit = 0.9995 * (upper + lower)
    distance = np.clip(np.linalg.norm(target, axis=-1), 0.25 * upper, limit)
    up = -unit(target)
    side = unit(np.cross(up, forward))
    straight = np.stack([np.cross(side, up), side, up], axis=-1)
    bend = np.arccos((upper**2 + distance**2 - lower**2) / (2 * upper * distance))
    knee = np.pi - np.arccos((upper**2 + lower**2 - distance**2) / (2 * upper * lower))
    thigh = straight @ about("y", -bend)
    return thigh, thigh @ about("y", knee)


def right_arm(pose: Pose, palm: np.ndarray, elbow: np.ndarray) -> np.ndarray:
    """Right shoulder and elbow [T, 2, 3, 3] that bring the palm to a point.

    Args:
        pose: where the chest is.
        palm: where the middle of the right hand is to be [T, 3], world.
        elbow: where the elbow points to [T, 3], world axes.
    """
    origins, rotations = pose.frames()
    index = int(np.flatnonzero(body().joint == RIGHT_SHOULDER)[0])
    target = palm - origins[:, index]
    reach = 0.999 * (UPPER_ARM + PALM)
    distance = np.minimum(np.linalg.norm(target, axis=-1), reach)
    back = -unit(target)
    inside = -unit(elbow - np.sum(elbow * back, -1, keepdims=True) * back)
    straight = np.stack([inside, back, np.cross(inside, back)], axis=-1)
    open_angle = np.arccos(
        (UPPER_ARM**2 + distance**2 - PALM**2) / (2 * UPPER_ARM * distance)
    )
    fold = np.pi - np.arccos(
        (UPPER_ARM**2 + PALM**2 - distance**2) / (2 * UPPER_ARM * PALM)
    )
    shoulder = rotations[:, CHEST].swapaxes(-1, -2) @ straight @ about("z", -open_angle)
    return np.stack([shoulder, about("z", fold)], 1)
