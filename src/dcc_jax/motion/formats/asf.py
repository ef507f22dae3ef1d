"""Acclaim skeletons (`.asf`): sections of bones, and how they hang together."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import CMU_UNIT, MAX_NODES
from dcc_jax.motion.formats.text import number, read_text

_CMU_LENGTH = 0.45  # what `length` says in CMU's files, whose base unit is the inch


@dataclass
class Bone:
    """One bone; the root is one whose direction is its position."""

    name: str
    line: int
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    order: str = "xyz"
    dof: tuple[str, ...] = ()


@dataclass(frozen=True)
class Skeleton:
    """A skeleton as its file has it, zero pose and units included."""

    path: str
    bones: dict[str, Bone]  # by name, the root included, parents first
    parents: dict[str, str]
    unit: float | None  # m
    degrees: bool


def is_asf(head: str) -> bool:
    """Whether a text that begins like this is a skeleton."""
    return bool(re.search(r"^\s*:(version|units|name)\b", head, re.I | re.M)) and (
        ":fully-specified" not in head.lower()
    )


def read_asf(path: str | Path) -> Skeleton:
    """Reads a skeleton.

    Raises:
        MotionError: anything wrong with the file.
    """
    sections = _sections(path, read_text(path))
    units = {row[0].lower(): (row, line) for row, line in sections.get("units", [])}
    unit = None
    if "length" in units:
        row, line = units["length"]
        factor = number(path, (*row, "")[1], line)
        if factor <= 0.0:
            raise MotionError(path, f"unit of length {factor:g}", line)
        # A factor of 1 is no claim about inches or metres: other exporters write it.
        unit = None if factor == 1.0 else CMU_UNIT * _CMU_LENGTH / factor
    degrees = "angle" not in units or not units["angle"][0][-1].lower().startswith(
        "rad"
    )
    for name in ("root", "bonedata", "hierarchy"):
        if name not in sections:
            raise MotionError(path, f"has no :{name} section")
    bones = {"root": _root(path, sections["root"])}
    for bone in _bones(path, iter(sections["bonedata"])):
        if bone.name in bones:
            raise MotionError(path, f"bone {bone.name!r} is listed twice", bone.line)
        bones[bone.name] = bone
        if len(bones) > MAX_NODES:
            raise MotionError(path, f"more than {MAX_NODES} bones", bone.line)
    parents = _parents(path, sections["hierarchy"], bones)
    order = _parents_first(path, parents, bones)
    return Skeleton(str(path), {n: bones[n] for n in order}, parents, unit, degrees)


_Row = tuple[list[str], int]


def _sections(path: str | Path, text: str) -> dict[str, list[_Row]]:
    """Rows of words with their line, by the section they stand in."""
    sections: dict[str, list[_Row]] = {}
    current: list[_Row] | None = None
    for line, raw in enumerate(text.splitlines(), 1):
        words = re.sub(r"[,()]", " ", raw.split("#")[0]).split()
        if not words:
            continue
        if words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
        elif current is None:
            raise MotionError(path, f"{words[0][:40]!r} before any section", line)
        else:
            current.append((words, line))
    return sections


def _root(path: str | Path, rows: list[_Row]) -> Bone:
    """The root as a bone: `direction` is its position."""
    root = Bone("root", rows[0][1] if rows else 1)
    for words, line in rows:
        key, rest = words[0].lower(), words[1:]
        if key == "order":
            root.dof = tuple(word.lower() for word in rest)
        elif key == "axis":
            root.order = _order(path, rest, line)
        elif key == "position":
            root.direction = _three(path, rest, line)
        elif key == "orientation":
            root.axis = _three(path, rest, line)
    if not root.dof or set(root.dof) - {"tx", "ty", "tz", "rx", "ry", "rz", "l"}:
        raise MotionError(path, "the root has no usable 'order'", root.line)
    return root


def _bones(path: str | Path, rows: Iterator[_Row]) -> Iterator[Bone]:
    """The bones of `:bonedata`, one from each begin to its end."""
    setters: dict[str, Callable[[Bone, list[str], int], None]] = {
        "name": lambda b, w, n: setattr(b, "name", " ".join(w)),
        "direction": lambda b, w, n: setattr(b, "direction", _three(path, w, n)),
        "length": lambda b, w, n: setattr(b, "length", number(path, (*w, "")[0], n)),
        "dof": lambda b, w, n: setattr(b, "dof", tuple(word.lower() for word in w)),
    }
    for words, line in rows:
        if words[0].lower() != "begin":
            raise MotionError(path, f"expected 'begin', got {words[0][:40]!r}", line)
        bone = Bone("", line)
        for inner, at in rows:
            key = inner[0].lower()
            if key == "end":
                break
            if key == "begin":
                raise MotionError(path, "a bone begins inside another", at)
            if key == "axis":
                bone.axis = _three(path, inner[1:4], at)
                bone.order = _order(path, inner[4:], at)
            elif key in setters:
                setters[key](bone, inner[1:], at)
        else:
            raise MotionError(path, "the file ends inside a bone", line)
        if not bone.name:
            raise MotionError(path, "a bone without a name", line)
        if set(bone.dof) - {"tx", "ty", "tz", "rx", "ry", "rz", "l"}:
            raise MotionError(path, f"bone {bone.name!r} has an unknown dof", line)
        yield bone


def _three(path: str | Path, words: list[str], line: int) -> np.ndarray:
    if len(words) < 3:
        raise MotionError(path, f"expected 3 numbers, got {len(words)}", line)
    return np.array([number(path, word, line) for word in words[:3]])


def _order(path: str | Path, words: list[str], line: int) -> str:
    order = words[0].lower() if words else "xyz"
    if sorted(order) != ["x", "y", "z"]:
        raise MotionError(path, f"unknown order of axes {order[:40]!r}", line)
    return order


def _parents(
    path: str | Path, rows: list[_Row], bones: dict[str, Bone]
) -> dict[str, str]:
    """The parent of every bone."""
    parents: dict[str, str] = {}
    for words, line in rows:
        if words[0].lower() in ("begin", "end"):
            continue
        for name in words:
            if name not in bones:
                raise MotionError(path, f"unknown bone {name[:40]!r}", line)
        for child in words[1:]:
            if child in parents or child == "root":
                raise MotionError(path, f"{child[:40]!r} has two parents", line)
            parents[child] = words[0]
    return parents


def _parents_first(
    path: str | Path, parents: dict[str, str], bones: dict[str, Bone]
) -> list[str]:
    """The bones in an order in which parents come before children."""
    children: dict[str, list[str]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
    order, waiting = [], ["root"]
    while waiting:
        order.append(waiting.pop())
        waiting += reversed(children.get(order[-1], []))
    loose = [name for name in bones if name not in order]
    if loose:
        raise MotionError(
            path, f"bone {loose[0]!r} does not hang on the root", bones[loose[0]].line
        )
    return order
