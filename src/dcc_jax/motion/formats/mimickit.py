"""MimicKit clips of its humanoid, once converted from a pickle to an `.npz`.

Frames [T, 34]: the root's position and rotation vector, then the joints in the order of
the character's tree, rotation vectors for balls and angles for elbows and knees.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion, demand_finite, world_rotations

# Our body, parent, offset (m), axes of the numbers. The zero pose is a T-pose.
_NODES = (
    ("pelvis", -1, (0.0, 0.0, 0.0), "xyz"),
    ("chest", 0, (0.0, 0.0, 0.236151), "xyz"),
    ("head", 1, (0.0, 0.0, 0.223894), "xyz"),
    ("right_upper_arm", 1, (-0.02405, -0.18311, 0.2435), "xyz"),
    ("right_forearm", 3, (0.0, -0.274788, 0.0), "z"),
    ("right_hand", 4, (0.0, -0.258947, 0.0), ""),
    ("left_upper_arm", 1, (-0.02405, 0.18311, 0.2435), "xyz"),
    ("left_forearm", 6, (0.0, 0.274788, 0.0), "z"),
    ("left_hand", 7, (0.0, 0.258947, 0.0), ""),
    ("right_thigh", 0, (0.0, -0.084887, 0.0), "xyz"),
    ("right_shin", 9, (0.0, 0.0, -0.421546), "y"),
    ("right_foot", 10, (0.0, 0.0, -0.40987), "xyz"),
    ("left_thigh", 0, (0.0, 0.084887, 0.0), "xyz"),
    ("left_shin", 12, (0.0, 0.0, -0.421546), "y"),
    ("left_foot", 13, (0.0, 0.0, -0.40987), "xyz"),
)
FRAME_SIZE = 3 + sum(len(node[3]) for node in _NODES)


def is_mimickit(names: frozenset[str]) -> bool:
    """Whether an archive with these members is one."""
    return {"frames", "fps"} <= names


def read_mimickit(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Motion:
    """Reads a clip with x forward and z up.

    Keys: `frames` [T, 34], `fps`, and `loop`, 1 for a clip that repeats.

    Raises:
        MotionError: anything wrong with the file, or another character's clip.
    """
    frames, fps = arrays["frames"], arrays["fps"]
    loop = arrays.get("loop", np.array(0))
    for name, array in (("frames", frames), ("fps", fps), ("loop", loop)):
        if array.dtype.kind not in "fiub" or (name != "frames" and array.size != 1):
            raise MotionError(path, f"{name} is {array.shape} of {array.dtype}")
    if frames.ndim != 2 or frames.shape[1] != FRAME_SIZE or not len(frames):
        reason = f"frames are {frames.shape}, not [T, {FRAME_SIZE}] of the humanoid"
        raise MotionError(path, reason)
    frames = frames.astype(float)
    if not np.isfinite(frames).all():
        raise MotionError(path, "frames hold a number that is not finite")
    local, column = [], 3
    for _, _, _, axes in _NODES:
        vectors = np.zeros((len(frames), 3))
        for axis in axes:
            vectors[:, "xyz".index(axis)] = frames[:, column]
            column += 1
        local.append(Rotation.from_rotvec(vectors))
    parents = tuple(node[1] for node in _NODES)
    bodies = tuple(node[0] for node in _NODES)
    return demand_finite(
        Motion(
            path=str(path),
            names=bodies,
            parents=parents,
            offsets=np.array([node[2] for node in _NODES]),
            root=frames[:, :3],
            quats=world_rotations(parents, local),
            fps=float(fps.ravel()[0]),
            unit=1.0,
            up="z",
            loop=bool(loop.ravel()[0]),
            roles={body: body for body in bodies},
        )
    )
