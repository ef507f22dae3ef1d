"""Skeleton arrays in `.npz`, as poselib and AMP keep their motions, without pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import (
    MAX_NODES,
    Motion,
    demand_finite,
    world_rotations,
)

_NEEDED = ("node_names", "parent_indices", "local_translation", "root_translation")


def read_poselib(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Motion:
    """Reads a motion of any skeleton, x forward and z up.

    Keys: `fps`, `node_names` [J], `parent_indices` [J], `local_translation` [J, 3],
    `root_translation` [T, 3], `rotation_xyzw` [T, J, 4], `is_local` (true: all but the
    root's are relative to the parent).

    Args:
        path: the file, for errors.
        arrays: what it holds.

    Raises:
        MotionError: anything wrong with the file.
    """
    parents = _checked(path, arrays)
    rotation = arrays["rotation_xyzw"].astype(float)
    norms = np.linalg.norm(rotation, axis=-1)
    if not (np.abs(norms - 1.0) < 0.5).all():
        frame = int(np.argmin((np.abs(norms - 1.0) < 0.5).all(axis=1)))
        raise MotionError(
            path, f"frame {frame} holds a quaternion far from unit length"
        )
    turns = [Rotation.from_quat(rotation[:, node]) for node in range(len(parents))]
    if bool(arrays.get("is_local", np.array(True))):
        quats = world_rotations(parents, turns)
    else:
        quats = np.stack([turn.as_quat(scalar_first=True) for turn in turns], axis=1)
    offsets = arrays["local_translation"].astype(float)
    offsets[0] = 0.0
    return demand_finite(
        Motion(
            path=str(path),
            names=tuple(str(name) for name in arrays["node_names"]),
            parents=parents,
            offsets=offsets,
            root=arrays["root_translation"].astype(float),
            quats=quats,
            fps=float(arrays["fps"]),
            up="z",
        )
    )


def _checked(path: str | Path, arrays: Mapping[str, np.ndarray]) -> tuple[int, ...]:
    """The parents, once every array has the shape and kind it should have."""
    missing = [key for key in (*_NEEDED, "rotation_xyzw", "fps") if key not in arrays]
    if missing:
        raise MotionError(path, f"not a motion: it lacks {', '.join(missing)}")
    nodes, frames = (
        arrays["node_names"].size,
        len(np.atleast_1d(arrays["root_translation"])),
    )
    shapes = {
        "node_names": (nodes,),
        "parent_indices": (nodes,),
        "local_translation": (nodes, 3),
        "root_translation": (frames, 3),
        "rotation_xyzw": (frames, nodes, 4),
        "fps": (),
    }
    for key, shape in shapes.items():
        if arrays[key].shape != shape:
            raise MotionError(path, f"{key} is {arrays[key].shape}, not {shape}")
        if arrays[key].dtype.kind not in ("SU" if key == "node_names" else "fiu"):
            raise MotionError(path, f"{key} holds {arrays[key].dtype}")
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            raise MotionError(path, f"{key} holds a number that is not finite")
    if arrays.get("is_local", np.array(True)).shape != ():
        raise MotionError(path, "is_local must be a single value")
    if not 1 <= nodes <= MAX_NODES or frames < 1:
        raise MotionError(path, f"has {nodes} nodes and {frames} frames")
    if len(set(arrays["node_names"].tolist())) != nodes:
        raise MotionError(path, "node names are not unique")
    parents = tuple(int(parent) for parent in arrays["parent_indices"])
    for node, parent in enumerate(parents):
        if parent != -1 if node == 0 else not 0 <= parent < node:
            raise MotionError(path, f"node {node} cannot have the parent {parent}")
    return parents
