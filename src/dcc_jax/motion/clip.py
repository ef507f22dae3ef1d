"""Motion clips of the character: one format, and the operations on a whole clip.

Letters: T frames. numpy and scipy only, so that offline commands start fast. The layout
of `qpos` is in `frames`, the format of the archive in `npz`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.character import Character
from dcc_jax.motion.formats.npz import MotionError, read_npz, write_npz
from dcc_jax.motion.frames import (
    continuous,
    join_qpos,
    moved,
    rotations,
    seam_defect,
    seam_of,
    split_qpos,
)

__all__ = [
    "Clip",
    "MotionError",
    "continuous",
    "crop",
    "join_qpos",
    "load_clip",
    "low_pass",
    "mirrored",
    "resample",
    "save_clip",
    "seam",
    "split_qpos",
    "velocities",
]

NQ, NV = Character.nq, Character.nv
LAYOUT = "dcc_jax clip 1"
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Clip:
    """One motion of the character at a constant frame rate.

    A clip with `loop` ends as it begins: its last frame equals the first one up to
    heading and place on the ground, so its period is (T - 1) / fps (see `seam`).
    """

    qpos: np.ndarray  # [T, 55] float32, MuJoCo's layout
    fps: float
    name: str
    source: str = ""  # where it comes from
    licence: str = ""  # its terms
    loop: bool = False
    label: str | None = None  # the skill, for conditioning
    phase: np.ndarray | None = None  # [T] float32 in [0, 1]

    @property
    def duration(self) -> float:
        """Time from the first to the last frame, s."""
        return (len(self.qpos) - 1) / self.fps


def load_clip(path: str | Path) -> Clip:
    """Reads and validates a clip; nothing is ever unpickled.

    Raises:
        MotionError: the file is no clip, is damaged, or holds an impossible motion.
    """
    arrays = read_npz(path)
    if str(arrays.get("layout", "")) != LAYOUT:
        raise MotionError(path, f"not a clip (its layout is not {LAYOUT!r})")
    missing = {"qpos", "fps", "name", "source", "licence", "loop"} - arrays.keys()
    if missing:
        raise MotionError(path, f"lacks {', '.join(sorted(missing))}")
    for key in ("fps", "name", "source", "licence", "loop"):
        if arrays[key].shape != ():
            raise MotionError(path, f"{key} must be a single value")
    if arrays["fps"].dtype.kind != "f" or arrays["loop"].dtype.kind != "b":
        raise MotionError(path, "fps must be a float and loop a boolean")
    clip = Clip(
        qpos=arrays["qpos"],
        fps=float(arrays["fps"]),
        name=str(arrays["name"]),
        source=str(arrays["source"]),
        licence=str(arrays["licence"]),
        loop=bool(arrays["loop"]),
        label=str(arrays["label"]) if "label" in arrays else None,
        phase=arrays.get("phase"),
    )
    validate(clip, path)
    return clip


def save_clip(path: str | Path, clip: Clip) -> None:
    """Writes a clip, all or nothing; equal clips give equal bytes.

    Raises:
        MotionError: the clip is not valid, or the file cannot be written.
    """
    validate(clip, path)
    arrays = {
        "layout": np.array(LAYOUT),
        "qpos": np.ascontiguousarray(clip.qpos),
        "fps": np.array(float(clip.fps)),
        "name": np.array(clip.name),
        "source": np.array(clip.source),
        "licence": np.array(clip.licence),
        "loop": np.array(clip.loop),
    }
    if clip.label is not None:
        arrays["label"] = np.array(clip.label)
    if clip.phase is not None:
        arrays["phase"] = np.ascontiguousarray(clip.phase)
    write_npz(path, arrays)


def validate(clip: Clip, path: str | Path) -> None:
    """Checks every promise of `Clip`; `path` is named in the error.

    Raises:
        MotionError: what is wrong, and in which frame.
    """

    def demand(good: bool | np.bool_, reason: str) -> None:
        if not good:
            raise MotionError(path, reason)

    qpos = clip.qpos
    demand(qpos.ndim == 2 and qpos.shape[1] == NQ, f"qpos is not [T, {NQ}]")
    demand(qpos.dtype == np.float32, f"qpos is {qpos.dtype}, not float32")
    demand(len(qpos) >= 2, f"a clip needs 2 frames, this has {len(qpos)}")
    demand(
        math.isfinite(clip.fps) and 0.1 <= clip.fps <= 10_000,
        f"fps is {clip.fps}, not in [0.1, 10000]",
    )
    finite = np.isfinite(qpos).all(axis=1)
    demand(finite.all(), f"frame {np.argmin(finite)} holds a number that is not finite")
    _, quats = split_qpos(qpos)
    error = np.abs(np.linalg.norm(quats, axis=-1) - 1.0).max(axis=1)
    demand(
        error.max() < UNIT_TOLERANCE,
        f"frame {error.argmax()} has a quaternion that is not of unit length",
    )
    flips = ((quats[1:] * quats[:-1]).sum(-1) < 0.0).any(axis=1)
    demand(not flips.any(), f"a quaternion changes its sign at frame {flips.argmax()}")
    if clip.phase is not None:
        demand(
            clip.phase.shape == (len(qpos),) and clip.phase.dtype == np.float32,
            "phase must be float32, one value a frame",
        )
        demand(
            ((clip.phase >= 0.0) & (clip.phase <= 1.0)).all(), "phase is not in [0, 1]"
        )
    if clip.loop:
        reason = seam_defect(qpos)
        demand(not reason, f"marked as a loop, but {reason}")


def seam(clip: Clip) -> tuple[float, np.ndarray]:
    """How far one period of a loop goes: its turn (rad) and shift [2] (m).

    A point p on the ground of the first frame is at Rz(turn) p + shift in the last.
    """
    turn, shift = seam_of(clip.qpos)
    return turn, shift[:2]


def velocities(clip: Clip) -> np.ndarray:
    """Velocities [T, 42] as MuJoCo's qvel, by central differences of the frames.

    The root's linear velocity is in the world, angular velocities are local to the
    joint's child. One-sided at the ends, across the seam where the clip loops.
    """
    rotation = rotations(clip.qpos)
    linear = np.diff(clip.qpos[:, :3].astype(float), axis=0)
    angular = (rotation[:-1].inv() * rotation[1:]).as_rotvec().reshape(-1, NV - 3)
    before, after = slice(0, 1), slice(-1, None)
    yaw = Rotation.identity()
    if clip.loop:
        before, after = after, before
        yaw = Rotation.from_euler("z", seam(clip)[0])
    linear = np.concatenate(
        [yaw.inv().apply(linear[before]), linear, yaw.apply(linear[after])]
    )
    angular = np.concatenate([angular[before], angular, angular[after]])
    steps = np.concatenate([linear, angular], axis=1)
    return (0.5 * clip.fps * (steps[1:] + steps[:-1])).astype(np.float32)


def resample(clip: Clip, fps: float) -> Clip:
    """The clip at another frame rate, rotations by slerp.

    A loop keeps a whole number of frames a period: its time is stretched by less than
    half a frame in the whole period. Any other clip loses what is left over at its end.

    Raises:
        ValueError: a rate that is not positive, or leaves less than 2 frames.
    """
    if not (math.isfinite(fps) and fps > 0.0):
        raise ValueError(f"fps must be positive, got {fps}")
    intervals = clip.duration * fps
    count = round(intervals) if clip.loop else math.floor(intervals + 1e-6)
    if count < 1:
        raise ValueError(f"{clip.duration:.3f} s at {fps} fps is less than 2 frames")
    stretch = clip.duration * fps / count if clip.loop else 1.0
    return sample(clip, np.arange(count + 1) / fps * stretch, fps)


def sample(clip: Clip, times: np.ndarray, fps: float) -> Clip:
    """The poses at the given times (s, clamped to the clip), called a clip at `fps`."""
    at = np.clip(times * clip.fps, 0.0, len(clip.qpos) - 1.0)
    left = np.minimum(at.astype(int), len(clip.qpos) - 2)
    share = at - left
    begin, end = rotations(clip.qpos[left]), rotations(clip.qpos[left + 1])
    step = share[:, None, None] * (begin.inv() * end).as_rotvec()
    quats = begin * Rotation.from_rotvec(step)
    position = clip.qpos[:, :3].astype(float)
    position = position[left] + share[:, None] * (position[left + 1] - position[left])
    phase = clip.phase
    if phase is not None:
        phase = np.interp(at, np.arange(len(phase)), phase).astype(np.float32)
    qpos = join_qpos(position, quats.as_quat(scalar_first=True))
    return replace(clip, qpos=qpos, fps=float(fps), phase=phase)


def crop(clip: Clip, start: float = 0.0, stop: float | None = None) -> Clip:
    """The part from `start` to `stop` (s), to the nearest frame; no longer a loop.

    Raises:
        ValueError: times outside the clip, or less than 2 frames between them.
    """
    stop = clip.duration if stop is None else stop
    if not 0.0 <= start < stop <= clip.duration + 0.5 / clip.fps:
        raise ValueError(
            f"crop from {start} to {stop} s is not within 0 to {clip.duration:.3f} s"
        )
    part = slice(round(start * clip.fps), round(stop * clip.fps) + 1)
    qpos = clip.qpos[part]
    if len(qpos) < 2:
        raise ValueError(f"crop from {start} to {stop} s leaves less than 2 frames")
    phase = None if clip.phase is None else clip.phase[part]
    qpos = join_qpos(*split_qpos(qpos))
    return replace(clip, qpos=qpos, phase=phase, loop=False)


def low_pass(clip: Clip, hz: float) -> Clip:
    """The motion without what is faster than `hz`, not delayed (Butterworth, twice).

    Raises:
        ValueError: a frequency not between 0 and half the frame rate.
    """
    if not 0.0 < hz < 0.5 * clip.fps:
        raise ValueError(f"hz must be within 0 and {0.5 * clip.fps}, got {hz}")
    from scipy.signal import butter, sosfiltfilt  # takes as long as jax to import

    sos = butter(2, hz, fs=clip.fps, output="sos")
    pad = min(len(clip.qpos) - 1, math.ceil(clip.fps))
    if clip.loop:
        flat = _with_neighbours(clip, pad)
        smooth = sosfiltfilt(sos, flat, axis=0, padlen=0)[pad : pad + len(clip.qpos)]
    else:
        flat = clip.qpos.astype(float)
        smooth = sosfiltfilt(sos, flat, axis=0, padlen=pad)
    position, quats = split_qpos(smooth)
    if clip.loop:
        turn, shift = seam_of(clip.qpos)
        ends = moved(smooth[:1], turn, shift)
        position[-1:], quats[-1:] = split_qpos(ends)
    return replace(clip, qpos=join_qpos(position, quats))


_LEFT_RIGHT = (0, 1, 2, 5, 6, 3, 4, 10, 11, 12, 7, 8, 9)  # root first, then the joints


def mirrored(clip: Clip) -> Clip:
    """The motion seen in a mirror: y and left-right change sides."""
    position, quats = split_qpos(clip.qpos)
    position = position * [1.0, -1.0, 1.0]
    quats = quats[:, _LEFT_RIGHT] * [1.0, -1.0, 1.0, -1.0]
    return replace(clip, qpos=join_qpos(position, quats), name=f"{clip.name}_mirrored")


def _with_neighbours(clip: Clip, count: int) -> np.ndarray:
    """The frames of a loop with `count` frames of the periods before and after."""
    qpos = clip.qpos.astype(float)
    turn, shift = seam_of(qpos)
    back = -Rotation.from_euler("z", -turn).apply(shift)
    before = moved(qpos[-1 - count : -1], -turn, back)
    after = moved(qpos[1 : count + 1], turn, shift)
    position, quats = split_qpos(np.concatenate([before, qpos, after]))
    return np.concatenate([position, continuous(quats).reshape(len(quats), -1)], axis=1)
