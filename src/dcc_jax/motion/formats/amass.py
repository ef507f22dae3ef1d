"""AMASS archives (`.npz`): poses of the SMPL family of body models.

The archives hold rotations but no skeleton: that is part of a body model with its own
licence. Rotations are all a rotation copy needs, so a plain figure stands in: the
directions of its bones are those of SMPL's zero pose (a T-pose, y up, facing z), its
lengths those of an adult.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion, demand_finite, world_rotations

# SMPL's joint, our body, parent, offset (m). All that follow are hands and fingers.
_JOINTS = (
    ("Pelvis", "pelvis", -1, (0.0, 0.0, 0.0)),
    ("L_Hip", "left_thigh", 0, (0.08, -0.08, 0.0)),
    ("R_Hip", "right_thigh", 0, (-0.08, -0.08, 0.0)),
    ("Spine1", "", 0, (0.0, 0.12, 0.0)),
    ("L_Knee", "left_shin", 1, (0.0, -0.40, 0.0)),
    ("R_Knee", "right_shin", 2, (0.0, -0.40, 0.0)),
    ("Spine2", "", 3, (0.0, 0.14, 0.0)),
    ("L_Ankle", "left_foot", 4, (0.0, -0.40, 0.0)),
    ("R_Ankle", "right_foot", 5, (0.0, -0.40, 0.0)),
    ("Spine3", "chest", 6, (0.0, 0.05, 0.0)),
    ("L_Foot", "left_toe", 7, (0.0, -0.06, 0.13)),
    ("R_Foot", "right_toe", 8, (0.0, -0.06, 0.13)),
    ("Neck", "", 9, (0.0, 0.21, 0.0)),
    ("L_Collar", "", 9, (0.07, 0.11, 0.0)),
    ("R_Collar", "", 9, (-0.07, 0.11, 0.0)),
    ("Head", "head", 12, (0.0, 0.10, 0.0)),
    ("L_Shoulder", "left_upper_arm", 13, (0.11, 0.03, 0.0)),
    ("R_Shoulder", "right_upper_arm", 14, (-0.11, 0.03, 0.0)),
    ("L_Elbow", "left_forearm", 16, (0.27, 0.0, 0.0)),
    ("R_Elbow", "right_forearm", 17, (-0.27, 0.0, 0.0)),
    ("L_Wrist", "left_hand", 18, (0.25, 0.0, 0.0)),
    ("R_Wrist", "right_hand", 19, (-0.25, 0.0, 0.0)),
)
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
DEFAULT_FPS = 120.0  # of most of AMASS, for archives that do not say


def is_amass(names: frozenset[str]) -> bool:
    """Whether an archive with these members is one."""
    return "trans" in names and bool(names & {"poses", "pose_body"})


def read_amass(
    path: str | Path, arrays: Mapping[str, np.ndarray], fps: float | None = None
) -> Motion:
    """Reads a motion with z up.

    Keys: `poses` [T, 66 and more] rotation vectors, or `root_orient` [T, 3] and
    `pose_body` [T, 63]; `trans` [T, 3] m; `mocap_framerate`.

    Args:
        path: the file, for errors.
        arrays: what it holds.
        fps: its frame rate, if the caller knows it.

    Raises:
        MotionError: anything wrong with the file.
    """
    poses, trans = _poses(path, arrays), _numbers(path, arrays, "trans")
    frames = len(poses)
    if trans.shape != (frames, 3):
        raise MotionError(path, f"trans is {trans.shape}, not {(frames, 3)}")
    notes = ["an AMASS archive says nothing of bones: legs taken as 0.80 m"]
    key = next((key for key in _RATES if key in arrays), None)
    if fps is None and key is None:
        notes.append(f"the file states no frame rate, taken as {DEFAULT_FPS:g} fps")
    elif fps is None and key is not None:
        rate = _numbers(path, arrays, key)
        if rate.size != 1:
            raise MotionError(path, f"{key} must be a single value")
        fps = float(rate.ravel()[0])
    parents = tuple(joint[2] for joint in _JOINTS)
    turns = [Rotation.from_rotvec(poses[:, node]) for node in range(len(_JOINTS))]
    return demand_finite(
        Motion(
            path=str(path),
            names=tuple(joint[0] for joint in _JOINTS),
            parents=parents,
            offsets=np.array([joint[3] for joint in _JOINTS]),
            root=trans,
            quats=world_rotations(parents, turns),
            fps=DEFAULT_FPS if fps is None else fps,
            unit=1.0,
            up="z",
            roles={body: name for name, body, _, _ in _JOINTS if body},
            notes=tuple(notes),
        )
    )


def _poses(path: str | Path, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rotation vectors [T, 22, 3] of the body's joints."""
    if "poses" in arrays:
        poses = _numbers(path, arrays, "poses")
    else:
        if "root_orient" not in arrays:
            raise MotionError(path, "pose_body without root_orient")
        parts = [_numbers(path, arrays, key) for key in ("root_orient", "pose_body")]
        if any(p.ndim != 2 for p in parts) or len({len(p) for p in parts}) != 1:
            raise MotionError(path, "root_orient and pose_body do not fit each other")
        poses = np.concatenate(parts, axis=1)
    width = 3 * len(_JOINTS)
    if poses.ndim != 2 or poses.shape[1] < width or not len(poses):
        raise MotionError(path, f"poses are {poses.shape}, not [T, {width} or more]")
    return poses[:, :width].reshape(len(poses), -1, 3)


def _numbers(
    path: str | Path, arrays: Mapping[str, np.ndarray], key: str
) -> np.ndarray:
    """One array as finite numbers."""
    if arrays[key].dtype.kind not in "fiu":
        raise MotionError(path, f"{key} holds {arrays[key].dtype}")
    values = arrays[key].astype(float)
    if not np.isfinite(values).all():
        raise MotionError(path, f"{key} holds a number that is not finite")
    return values
