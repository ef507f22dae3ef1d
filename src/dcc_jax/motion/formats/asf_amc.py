"""Acclaim skeletons (`.asf`) and motions (`.amc`), as CMU and HDM05 publish them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.asf import Bone, Skeleton, read_asf
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion, demand_finite, world_rotations
from dcc_jax.motion.formats.text import number, read_text

DEFAULT_FPS = 120.0  # the capture rate of both databases; the files do not state it
_MINOR = re.compile(r"finger|thumb|toe|hand|wrist|clavicle", re.IGNORECASE)
"""Bones that may be missing from a frame: they then rest."""


def is_amc(head: str) -> bool:
    """Whether a text that begins like this is a motion."""
    return bool(
        re.search(r"^\s*:(fully-specified|degrees|radians)\b", head, re.I | re.M)
    )


def choose_skeleton(motion: Path, skeletons: Sequence[Path]) -> Path:
    """Which of some `.asf` files belongs to a motion, by their names.

    `SUBJECT.asf` and `SUBJECT-anything.asf` go with `SUBJECT_anything.amc`; the longest
    subject wins. Where no name fits, a single skeleton is taken for the right one.

    Raises:
        MotionError: there is none, or it is not clear which.
    """
    stem = motion.stem.lower()
    starts = {path: re.split(r"[-. ]", path.stem.lower())[0] for path in skeletons}
    fitting = [
        path
        for path, start in starts.items()
        if path.stem.lower() == stem or re.match(re.escape(start) + "[_-]", stem)
    ]
    best = max((len(starts[path]) for path in fitting), default=0)
    fitting = [path for path in fitting if len(starts[path]) == best]
    found = fitting if len(fitting) == 1 else list(skeletons)
    if len(found) != 1:
        raise MotionError(
            motion,
            f"needs its skeleton: of {len(found)} .asf files none is clearly its own; "
            "name it as another source",
        )
    return found[0]


def skeletons_beside(motion: Path) -> list[Path]:
    """The `.asf` files in the directory of a motion."""
    return sorted(p for p in motion.parent.glob("*") if p.suffix.lower() == ".asf")


def read_amc(
    path: str | Path, skeleton: str | Path, fps: float = DEFAULT_FPS
) -> Motion:
    """Reads a motion on its skeleton, in the file's axes and unit.

    With C the bone's axis rotation and M its degrees of freedom, both about fixed axes
    in the order of the axis token, a bone turns by C M C^-1 relative to its parent. It
    turns about its start, which is the end of its parent.

    Args:
        path: the `.amc` file.
        skeleton: the `.asf` file.
        fps: frame rate, which the file does not state.

    Raises:
        MotionError: anything wrong with either file.
    """
    figure = read_asf(skeleton)
    values, degrees, missing = _frames(path, figure)
    local = [
        _rotation(
            bone, values[name], degrees if degrees is not None else figure.degrees
        )
        for name, bone in figure.bones.items()
    ]
    names = list(figure.bones)
    parents = [names.index(figure.parents[n]) if n != "root" else -1 for n in names]
    ends = {n: b.direction * b.length for n, b in figure.bones.items()}
    offsets = [np.zeros(3) if n == "root" else ends[figure.parents[n]] for n in names]
    for node, name in enumerate(figure.bones):
        if name not in figure.parents.values():
            names.append(f"{name}_end")
            parents.append(node)
            offsets.append(ends[name])
            local.append(Rotation.identity(len(local[0])))
    notes = tuple(f"{name} is missing from some frames" for name in sorted(missing))
    return demand_finite(
        Motion(
            path=str(path),
            names=tuple(names),
            parents=tuple(parents),
            offsets=np.array(offsets),
            root=_root_path(figure.bones["root"], values["root"]),
            quats=world_rotations(tuple(parents), local),
            fps=fps,
            unit=figure.unit,
            notes=notes,
        )
    )


def _root_path(root: Bone, values: np.ndarray) -> np.ndarray:
    """Positions [T, 3] of the root."""
    path = np.tile(root.direction, (len(values), 1))
    for axis, letter in enumerate("xyz"):
        if f"t{letter}" in root.dof:
            path[:, axis] += values[:, root.dof.index(f"t{letter}")]
    return path


def _rotation(bone: Bone, values: np.ndarray, degrees: bool) -> Rotation:
    """Rotations [T] of a bone relative to its parent."""
    angles = np.zeros((len(values), 3))
    for column, letter in enumerate(bone.order):
        if f"r{letter}" in bone.dof:
            angles[:, column] = values[:, bone.dof.index(f"r{letter}")]
    turn = Rotation.from_euler(bone.order, angles, degrees=degrees)
    frame = Rotation.from_euler(bone.order, bone.axis, degrees=degrees)
    return frame * turn * frame.inv()


def _frames(
    path: str | Path, figure: Skeleton
) -> tuple[dict[str, np.ndarray], bool | None, set[str]]:
    """Values [T, dof] by bone; are they degrees; which bones some frames lack."""
    moving = {name: len(bone.dof) for name, bone in figure.bones.items() if bone.dof}
    columns: dict[str, list[list[str]]] = {name: [] for name in figure.bones}
    lines: dict[str, list[int]] = {name: [] for name in figure.bones}
    degrees, count, missing = None, 0, set()
    first = 0
    line = 0

    def close(at: int) -> None:
        for name, width in moving.items():
            if len(columns[name]) < count:
                if not _MINOR.search(name):
                    raise MotionError(path, f"frame {count} lacks bone {name!r}", at)
                missing.add(name)
                columns[name].append(["0"] * width)
                lines[name].append(at)

    for line, raw in enumerate(read_text(path).splitlines(), 1):
        words = raw.split()
        if not words or words[0][0] == "#":
            continue
        key = words[0]
        if key[0] == ":":
            degrees = {":degrees": True, ":radians": False}.get(key.lower(), degrees)
        elif key in moving:
            if not count or len(columns[key]) != count - 1:
                raise MotionError(path, f"bone {key!r} is out of place", line)
            if len(words) != moving[key] + 1:
                reason = f"{key!r} has {len(words) - 1} values, not {moving[key]}"
                raise MotionError(path, reason, line)
            columns[key].append(words[1:])
            lines[key].append(line)
        elif len(words) == 1 and key.isdecimal():
            close(line)
            first = first or int(key)
            if int(key) != first + count:
                reason = f"frame {key[:40]} follows frame {first + count - 1}"
                raise MotionError(path, reason, line)
            count += 1
        else:
            raise MotionError(path, f"unknown bone {key[:40]!r}", line)
    if not count:
        raise MotionError(path, "holds no frames", line)
    close(line)
    values = {
        name: _numbers(path, rows, lines[name], count) for name, rows in columns.items()
    }
    return values, degrees, missing


def _numbers(
    path: str | Path, rows: list[list[str]], lines: list[int], count: int
) -> np.ndarray:
    """The numbers [T, D] of one bone."""
    if not rows:
        return np.zeros((count, 0))
    try:
        values = np.array(rows, float)
    except ValueError:
        values = np.array([[np.nan]])
    if np.isfinite(values).all():
        return values
    return np.array(
        [
            [number(path, word, line) for word in words]
            for words, line in zip(rows, lines, strict=True)
        ]
    )
