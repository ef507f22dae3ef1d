"""Frames of the character's motion as arrays `qpos` [T, 55] in MuJoCo's layout.

Letters: T frames; 13 rotations a frame (the root, then the 12 joints). Rotations are
(w, x, y, z), unit, and continuous in sign along a motion.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.character import Character

ROTATIONS = Character.num_joints + 1
LOOP_ANGLE = math.radians(2.0)  # the seam a loop may have, by joint
LOOP_HEIGHT = 0.02  # m


def split_qpos(qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root positions [T, 3] (m) and rotations [T, 13, 4], the root's first."""
    return qpos[..., :3], qpos[..., 3:].reshape(*qpos.shape[:-1], ROTATIONS, 4)


def join_qpos(position: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """The inverse of `split_qpos`, [T, 55] float32, with continuous signs."""
    quats = continuous(quats)
    flat = quats.reshape(*quats.shape[:-2], 4 * ROTATIONS)
    return np.concatenate([position, flat], axis=-1).astype(np.float32)


def continuous(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions [T, ..., 4] whose signs never jump; the first has w >= 0."""
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    first = np.where(quats[:1, ..., 0] < 0.0, -1.0, 1.0)
    turns = np.where((quats[1:] * quats[:-1]).sum(-1) < 0.0, -1.0, 1.0)
    return quats * np.cumprod(np.concatenate([first, turns]), axis=0)[..., None]


def rotations(qpos: np.ndarray) -> Rotation:
    """The 13 rotations of every frame, an array [T, 13]."""
    return to_rotation(split_qpos(qpos)[1])


def to_rotation(quats: np.ndarray) -> Rotation:
    """scipy's rotations [...] of quaternions [..., 4]."""
    return Rotation.from_quat(quats, scalar_first=True)


def to_quats(rotation: Rotation) -> np.ndarray:
    """Quaternions [..., 4] of scipy's rotations [...]."""
    return rotation.as_quat(scalar_first=True)


def seam_of(qpos: np.ndarray) -> tuple[float, np.ndarray]:
    """Turn and shift [3] with last frame = moved first frame; the shift's z is 0."""
    begin, end = to_rotation(qpos[0, 3:7]), to_rotation(qpos[-1, 3:7])
    matrix = (end * begin.inv()).as_matrix()
    turn = math.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    shift = qpos[-1, :3] - Rotation.from_euler("z", turn).apply(qpos[0, :3])
    return turn, shift * [1.0, 1.0, 0.0]


def moved(qpos: np.ndarray, turn: float, shift: np.ndarray) -> np.ndarray:
    """Frames turned about the world's z axis, then shifted."""
    yaw = Rotation.from_euler("z", turn)
    root = yaw * to_rotation(qpos[:, 3:7])
    moved = np.array(qpos, float)
    moved[:, :3] = yaw.apply(qpos[:, :3]) + shift
    moved[:, 3:7] = to_quats(root)
    return moved


def seam_defect(qpos: np.ndarray) -> str:
    """Why the last frame is not the first one over again; empty where it is."""
    turn, shift = seam_of(qpos)
    begin, end = rotations(np.stack([moved(qpos[:1], turn, shift)[0], qpos[-1]]))
    angle = (begin.inv() * end).magnitude().max()
    height = abs(float(qpos[-1, 2] - qpos[0, 2]))
    if angle > LOOP_ANGLE:
        return f"its ends differ by {math.degrees(angle):.1f} degrees"
    if height > LOOP_HEIGHT:
        return f"its ends differ by {100.0 * height:.1f} cm in height"
    return ""
