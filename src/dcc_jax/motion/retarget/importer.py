"""Any motion file into a clip of the character."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dcc_jax.motion.formats.archive import is_archive, read_archive
from dcc_jax.motion.formats.asf import is_asf
from dcc_jax.motion.formats.asf_amc import (
    DEFAULT_FPS,
    choose_skeleton,
    is_amc,
    read_amc,
    skeletons_beside,
)
from dcc_jax.motion.formats.bvh import is_bvh, read_bvh
from dcc_jax.motion.formats.deepmimic import is_deepmimic, read_deepmimic
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import AXES, UNITS, Motion, rest_on_frame
from dcc_jax.motion.retarget.anatomy import Anatomy
from dcc_jax.motion.retarget.lead_in import without_repeats, without_rest_pose
from dcc_jax.motion.retarget.loops import as_loop
from dcc_jax.motion.retarget.match import match
from dcc_jax.motion.retarget.quality import measure
from dcc_jax.motion.retarget.retarget import LOW_PASS, Retargeted, placed, retarget
from dcc_jax.motion.retarget.sides import SIDES, refuse_swapped_sides, with_sides
from dcc_jax.motion.retarget.verdict import doubts

FORMATS = ("amc", "bvh", "deepmimic", "npz")
LEGS = (
    0.2,
    2.0,
)  # m, of thigh and shin of any person, by which a given unit is checked
BONES = ("thigh", "shin", "upper_arm")  # without which there is no figure
_HEAD = 4096  # bytes that tell the format


@dataclass(frozen=True)
class Options:
    """What the caller knows better than the file."""

    format: str = "auto"
    fps: float = 30.0  # of the clip
    source_fps: float | None = None  # of the file
    unit: str | None = None
    up: str | None = None
    names: Mapping[str, str] | None = None  # node by body
    root: str | None = None  # which ROOT of a BVH file
    sides: str = "keep"  # what to do to left and right
    rest_frame: int | None = None  # a frame that stands upright, arms out or down
    trim: tuple[float, float] | None = None  # s
    loop: bool = False
    low_pass: float = LOW_PASS  # Hz; 0 keeps everything
    clean: bool = True

    def __post_init__(self) -> None:
        _check_choice("format", self.format, ("auto", *FORMATS))
        _check_choice("unit", self.unit, (None, *UNITS))
        _check_choice("up", self.up, (None, *AXES))
        _check_choice("sides", self.sides, SIDES)
        for name in ("fps", "source_fps"):
            rate = getattr(self, name)
            if rate is not None and not 1.0 <= rate <= 1000.0:
                raise ValueError(f"{name} must be in [1, 1000] frames/s, got {rate:g}")
        if self.trim is not None and not 0.0 <= self.trim[0] < self.trim[1]:
            raise ValueError(f"trim must be two times, A before B, got {self.trim}")
        if not 0.0 <= self.low_pass < math.inf:
            raise ValueError(
                f"low_pass must be 0 or a frequency in Hz, got {self.low_pass:g}"
            )


def _check_choice(name: str, value: str | None, known: Sequence[str | None]) -> None:
    if value not in known:
        names = ", ".join(one for one in known if one is not None)
        raise ValueError(f"{name} must be one of {names}, got {value!r}")


def read_span(text: str) -> tuple[float, float]:
    """Two times, s, of `A:B`; without A from the start, without B to the end.

    Raises:
        ValueError: it is no such text.
    """
    start, colon, stop = text.partition(":")
    try:
        span = float(start or 0.0), float(stop or "inf")
    except ValueError:
        span = 0.0, 0.0
    if not colon or not 0.0 <= span[0] < span[1]:
        raise ValueError(f"trim must be two times A:B with A < B, got {text!r}")
    return span


def detect_format(path: Path) -> str:
    """`asf` or one of `FORMATS`, from the content.

    Raises:
        MotionError: the file cannot be read, or is nothing known.
    """
    try:
        with open(path, "rb") as stream:
            data = stream.read(_HEAD)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MotionError(path, f"cannot be read: {reason}") from None
    if not data.strip():
        raise MotionError(path, "the file is empty")
    head = data.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    tests = {
        "npz": is_archive(data),
        "bvh": is_bvh(head),
        "deepmimic": is_deepmimic(head),
        "amc": is_amc(head),
        "asf": is_asf(head),
    }
    found = next((name for name, fits in tests.items() if fits), None)
    if found is None:
        raise MotionError(path, f"the format is none of asf, {', '.join(FORMATS)}")
    return found


def read_motion(path: Path, options: Options, skeletons: Sequence[Path]) -> Motion:
    """Reads a file of any format, as it is.

    Args:
        path: the motion.
        options: the format and the frame rate, where they are given.
        skeletons: `.asf` files for motions that need one; by default what lies beside.

    Raises:
        MotionError: anything wrong with the file.
    """
    kind = detect_format(path) if options.format == "auto" else options.format
    if kind == "asf":
        raise MotionError(path, "a skeleton alone holds no motion")
    if kind == "amc":
        given = bool(skeletons)
        skeleton = choose_skeleton(path, skeletons or skeletons_beside(path))
        motion = read_amc(path, skeleton, options.source_fps or DEFAULT_FPS)
        notes = [] if given else [f"skeleton {skeleton.name}, found beside it"]
        if options.source_fps is None:
            notes.append(f"the file states no frame rate, taken as {DEFAULT_FPS:g} fps")
        return replace(motion, notes=(*notes, *motion.notes))
    if kind == "bvh":
        return read_bvh(path, options.source_fps, options.root)
    if kind == "npz":
        motion = read_archive(path, options.source_fps)
    else:
        motion = read_deepmimic(path)
    return replace(motion, fps=options.source_fps or motion.fps)


def import_motion(
    path: Path, options: Options, skeletons: Sequence[Path] = ()
) -> Retargeted:
    """A clip of the character from a file.

    Raises:
        MotionError: whatever is wrong, in one line.
    """
    try:
        motion = read_motion(path, options, skeletons)
        # Damaged numbers may be large enough to overflow; what comes out is checked.
        with np.errstate(all="ignore"):
            return _imported(motion, options)
    except MotionError:
        raise
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise MotionError(path, str(error)) from None
    except LookupError as error:
        raise MotionError(path, f"is no motion of a figure ({error})") from None
    except MemoryError:
        raise MotionError(path, "too long to hold in memory") from None


def _imported(motion: Motion, options: Options) -> Retargeted:
    if options.rest_frame is not None:
        motion = rest_on_frame(motion, options.rest_frame)
    motion = without_repeats(motion)
    bodies, notes = match(motion, options.names)
    motion = without_rest_pose(Anatomy(motion.noted(*notes), bodies))
    part = _part(motion, *options.trim) if options.trim else slice(None)
    if options.loop:
        motion = replace(motion, loop=False)
    figure = with_sides(Anatomy(motion, bodies), options.sides)
    check_lengths(figure, options.unit)
    refuse_swapped_sides(figure)
    result = retarget(
        figure, options.fps, options.up, options.low_pass, options.clean, part
    )
    if options.loop:
        clip = placed(as_loop(result.clip))
        result = replace(result, clip=clip, after=measure(clip))
    found = (*_guesses(result.notes), *result.doubts)
    return replace(result, doubts=(*found, *doubts(result.clip, result.after)))


def _guesses(notes: Sequence[str]) -> tuple[str, ...]:
    """What of the notes is more than information."""
    guesses = {
        "please check the joints": "joints were told by their place",
        "the world's up was taken": "up was guessed",
        "the file says nothing of where": "the way was made from the feet",
    }
    return tuple(
        guess
        for begin, guess in guesses.items()
        if any(note.startswith(begin) for note in notes)
    )


def check_lengths(figure: Anatomy, unit: str | None) -> None:
    """Checks the bones, and a unit that the user gave: the legs tell the scale.

    Raises:
        MotionError: a bone has no length, or nobody has such legs.
    """
    for bone in (f"{s}_{part}" for s in ("left", "right") for part in BONES):
        length = np.median(np.linalg.norm(figure.bone(bone), axis=1))
        if not length > 1e-6 * figure.leg_length > 0.0:
            raise MotionError(figure.motion.path, f"{bone} has no length")
    if unit is None:
        return
    legs = figure.leg_length * UNITS[unit]
    if not LEGS[0] < legs < LEGS[1]:
        reason = f"thigh and shin would be {legs:.3g} m long with --unit {unit}"
        raise MotionError(figure.motion.path, reason)


def _part(motion: Motion, start: float, stop: float) -> slice:
    """The frames of a motion between two times, s.

    Raises:
        MotionError: less than 2 frames lie between them.
    """
    last = (len(motion.root) - 1) / motion.fps
    stop = min(stop, last)
    if not (0.0 <= start < stop and math.isfinite(start)):
        raise MotionError(
            motion.path, f"nothing between {start:g} and {stop:g} s of {last:.2f} s"
        )
    return slice(round(start * motion.fps), round(stop * motion.fps) + 1)
