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
    values, degrees, notes = _frames(path, figure)
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
            notes=tuple(notes),
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


class _Table:
    """The rows of numbers of an AMC file, frame by frame."""

    def __init__(self, path: str | Path, figure: Skeleton) -> None:
        self.path = path
        self.sizes = {n: len(bone.dof) for n, bone in figure.bones.items() if bone.dof}
        self.rows: dict[str, list[list[str]]] = {name: [] for name in figure.bones}
        self.lines: dict[str, list[int]] = {name: [] for name in figure.bones}
        self.missing: set[str] = set()
        self.count = self.first = 0

    def begin(self, number: int, line: int) -> None:
        """The next frame begins with its number."""
        self.close(line)
        self.first = self.first or number
        if number != self.first + self.count:
            last = self.first + self.count - 1
            reason = f"frame {str(number)[:40]} follows frame {last}"
            raise MotionError(self.path, reason, line)
        self.count += 1

    def add(self, name: str, values: list[str], line: int) -> None:
        """The values of a bone in the frame at hand."""
        if not self.count or len(self.rows[name]) != self.count - 1:
            raise MotionError(self.path, f"bone {name!r} is out of place", line)
        if len(values) != self.sizes[name]:
            reason = f"{name!r} has {len(values)} values, not {self.sizes[name]}"
            raise MotionError(self.path, reason, line)
        self.rows[name].append(values)
        self.lines[name].append(line)

    def close(self, line: int) -> None:
        """The frame at hand is over: bones that may be missing rest."""
        lacking = [n for n in self.sizes if len(self.rows[n]) < self.count]
        for name in lacking:
            if not _MINOR.search(name):
                reason = f"frame {self.count} lacks bone {name!r}"
                raise MotionError(self.path, reason, line)
            self.missing.add(name)
            self.rows[name].append(["0"] * self.sizes[name])
            self.lines[name].append(line)

    def drop_last(self) -> None:
        """Forgets the frame at hand."""
        self.count -= 1
        for name in self.rows:
            del self.rows[name][self.count :], self.lines[name][self.count :]


def _frames(
    path: str | Path, figure: Skeleton
) -> tuple[dict[str, np.ndarray], bool | None, list[str]]:
    """Values [T, dof] by bone; are they degrees; what to tell the user.

    A last frame that is cut is left out: copies of files often end within a line.
    """
    table, degrees, line = _Table(path, figure), None, 0
    lines = [(n, raw.split()) for n, raw in enumerate(read_text(path).splitlines(), 1)]
    lines = [(n, words) for n, words in lines if words and words[0][0] != "#"]
    notes = []
    try:
        for line, words in lines:
            key = words[0]
            if key[0] == ":":
                unit = {":degrees": True, ":radians": False}
                degrees = unit.get(key.lower(), degrees)
            elif key in table.sizes:
                table.add(key, words[1:], line)
            elif len(words) == 1 and key.isdecimal():
                table.begin(int(key[:40]), line)
            else:
                raise MotionError(path, f"unknown bone {key[:40]!r}", line)
        table.close(line)
    except MotionError:
        # Only what the end of the file cut off may be wrong.
        if table.count < 3 or line != lines[-1][0]:
            raise
        table.drop_last()
        notes.append(f"the last frame is cut: {table.count} were taken")
    if not table.count:
        raise MotionError(path, "holds no frames", line or 1)
    values = {
        name: _numbers(path, rows, table.lines[name], table.count)
        for name, rows in table.rows.items()
    }
    notes += [f"{name} is missing from some frames" for name in sorted(table.missing)]
    return values, degrees, notes


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
