"""DeepMimic clips: JSON frames of 44 numbers on one fixed humanoid.

Source of layout and segment lengths: the DeepMimic project's `humanoid3d` character.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion, demand_finite, world_rotations
from dcc_jax.motion.formats.text import read_text

FRAME_SIZE = 44
MAX_FPS = 240.0
LEAST_FRAMES = 3_000
MOST_A_KEY = 50
"""Unequal durations are met by more frames than keys, but the file's size bounds them:
at most these, or so many a key."""
# Our body, parent, attachment (m), column, numbers (1: a hinge about z).
_NODES = (
    ("pelvis", "", (0.0, 0.0, 0.0), 4, 4),
    ("chest", "pelvis", (0.0, 0.236151, 0.0), 8, 4),
    ("head", "chest", (0.0, 0.223894, 0.0), 12, 4),
    ("right_thigh", "pelvis", (0.0, 0.0, 0.084887), 16, 4),
    ("right_shin", "right_thigh", (0.0, -0.421546, 0.0), 20, 1),
    ("right_foot", "right_shin", (0.0, -0.40987, 0.0), 21, 4),
    ("right_upper_arm", "chest", (-0.02405, 0.243532, 0.18311), 25, 4),
    ("right_forearm", "right_upper_arm", (0.0, -0.274788, 0.0), 29, 1),
    ("right_hand", "right_forearm", (0.0, -0.258947, 0.0), 0, 0),
    ("left_thigh", "pelvis", (0.0, 0.0, -0.084887), 30, 4),
    ("left_shin", "left_thigh", (0.0, -0.421546, 0.0), 34, 1),
    ("left_foot", "left_shin", (0.0, -0.40987, 0.0), 35, 4),
    ("left_upper_arm", "chest", (-0.02405, 0.243532, -0.18311), 39, 4),
    ("left_forearm", "left_upper_arm", (0.0, -0.274788, 0.0), 43, 1),
    ("left_hand", "left_forearm", (0.0, -0.258947, 0.0), 0, 0),
)


def is_deepmimic(head: str) -> bool:
    """Whether a text that begins like this is JSON."""
    return head.lstrip().startswith("{")


def read_deepmimic(path: str | Path) -> Motion:
    """Reads a clip, in its own axes (x forward, y up, z right), metres.

    Key frames may last differently long; they are interpolated at the shortest of
    their durations. Quaternions are normalized, which the published clips need.

    Raises:
        MotionError: anything wrong with the file.
    """
    try:
        document = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise MotionError(path, f"not JSON: {error.msg}", error.lineno) from None
    except (RecursionError, ValueError) as error:
        raise MotionError(path, f"not JSON: {error}") from None
    if not isinstance(document, dict) or "Frames" not in document:
        raise MotionError(path, "not a DeepMimic clip: it has no 'Frames'")
    keys, times = _keys(path, document["Frames"])
    fps, at = _regular_times(path, times)
    root = np.stack([np.interp(at, times, column) for column in keys[:, 1:4].T], axis=1)
    local = [_rotations(path, keys, times, at, node[3], node[4]) for node in _NODES]
    bodies = [node[0] for node in _NODES]
    parents = tuple(bodies.index(node[1]) if node[1] else -1 for node in _NODES)
    return demand_finite(
        Motion(
            path=str(path),
            names=tuple(bodies),
            parents=parents,
            offsets=np.array([node[2] for node in _NODES]),
            root=root,
            quats=world_rotations(parents, local),
            fps=fps,
            unit=1.0,
            up="y",
            loop=str(document.get("Loop", "none")).lower() == "wrap",
            roles={body: body for body in bodies},
        )
    )


def _keys(path: str | Path, frames: object) -> tuple[np.ndarray, np.ndarray]:
    """Key frames [K, 44] and their times [K]."""
    if not isinstance(frames, list) or not frames:
        raise MotionError(path, "holds no frames")
    for index, frame in enumerate(frames):
        if not isinstance(frame, list) or len(frame) != FRAME_SIZE:
            size = len(frame) if isinstance(frame, list) else "no list of"
            raise MotionError(
                path, f"frame {index} has {size} numbers, not {FRAME_SIZE}"
            )
        # bool is an int to Python, so the type itself is asked for
        if not all(type(value) in (int, float) for value in frame):
            raise MotionError(path, f"frame {index} holds what is not a number")
    try:
        keys = np.array(frames, float)
    except OverflowError:
        keys = np.array([[np.nan]])
    if not np.isfinite(keys).all():
        raise MotionError(path, "a number is not finite")
    if len(keys) < 2:
        raise MotionError(path, "a clip needs 2 frames, this has 1")
    durations = keys[:-1, 0]
    if not ((durations > 0.0) & (durations <= 10.0)).all():
        index = int(np.argmin((durations > 0.0) & (durations <= 10.0)))
        raise MotionError(path, f"frame {index} lasts {durations[index]} s")
    return keys, np.concatenate([[0.0], np.cumsum(durations)])


def _regular_times(path: str | Path, times: np.ndarray) -> tuple[float, np.ndarray]:
    """A constant frame rate and its times [T], the keys' own where they are regular."""
    steps = np.diff(times)
    if np.ptp(steps) < 1e-3 * steps.mean():
        return float(1.0 / steps.mean()), times
    most = max(LEAST_FRAMES, MOST_A_KEY * len(times))
    fps = float(min(1.0 / steps.min(), MAX_FPS, most / times[-1]))
    if fps < 1.0:
        raise MotionError(path, f"{len(times)} key frames last {times[-1]:.0f} s")
    count = round(times[-1] * fps)
    fps = max(count, 1) / float(times[-1])
    return fps, np.arange(max(count, 1) + 1) / fps


def _rotations(
    path: str | Path,
    keys: np.ndarray,
    times: np.ndarray,
    at: np.ndarray,
    column: int,
    size: int,
) -> Rotation:
    """Local rotations of one joint at the times `at`."""
    if size == 0:
        return Rotation.identity(len(at))
    if size == 1:
        angle = np.interp(at, times, keys[:, column])
        return Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
    quats = keys[:, column : column + 4]
    norms = np.linalg.norm(quats, axis=1)
    if (np.abs(norms - 1.0) > 0.5).any():
        index = int(np.argmax(np.abs(norms - 1.0)))
        raise MotionError(
            path,
            f"frame {index} column {column} holds a quaternion of norm "
            f"{norms[index]:.3g}",
        )
    left = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    share = (at - times[left]) / (times[left + 1] - times[left])
    begin = Rotation.from_quat(quats[left], scalar_first=True)
    end = Rotation.from_quat(quats[left + 1], scalar_first=True)
    step = (begin.inv() * end).as_rotvec() * np.clip(share, 0.0, 1.0)[:, None]
    return begin * Rotation.from_rotvec(step)
