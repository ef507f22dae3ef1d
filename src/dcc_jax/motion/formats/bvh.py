"""Biovision hierarchies (`.bvh`): HIERARCHY with offsets and channels, then MOTION."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.bvh_rows import Rows, read_rows
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import (
    MAX_NODES,
    Motion,
    demand_finite,
    world_rotations,
)
from dcc_jax.motion.formats.text import Tokens, read_text

_CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)
FEWEST = 12  # joints of a figure; a tree of less is a prop
_SPARSE = 4  # nodes a channel, above which a file claims more than it can hold


@dataclass(frozen=True)
class _Node:
    """One joint or end site; `channels` are such as ('position', 'x')."""

    name: str
    parent: int
    offset: np.ndarray  # [3], the file's unit
    channels: tuple[tuple[str, str], ...] = ()
    end: bool = False


def is_bvh(head: str) -> bool:
    """Whether a text that begins like this is a BVH file."""
    return head.lstrip().upper().startswith("HIERARCHY")


def read_bvh(
    path: str | Path, fps: float | None = None, root: str | None = None
) -> Motion:
    """Reads a BVH file, in its own axes and unit.

    Rotations are products of the channels in the order each joint lists them. Where
    the root has position channels they alone place it; its OFFSET is then ignored,
    since exporters disagree about what it means. Position channels count on any joint.

    Args:
        path: the file.
        fps: its frame rate, if the caller knows it.
        root: which ROOT to take; None: the only one that is a figure.

    Raises:
        MotionError: anything wrong with the file.
    """
    text = read_text(path)
    found = re.search(r"^[ \t]*MOTION\b", text, re.MULTILINE | re.IGNORECASE)
    if found is None:
        raise MotionError(path, "has no MOTION section", text.count("\n") + 1)
    nodes = _hierarchy(Tokens(path, text[: found.start()]))
    first_line = text.count("\n", 0, found.start()) + 1
    channels = sum(len(node.channels) for node in nodes)
    if len(nodes) > _SPARSE * channels + 100:
        raise MotionError(path, f"{len(nodes)} joints have {channels} channels")
    rows = read_rows(path, text[found.start() :], first_line, channels, fps)
    kept, notes = _figure(str(path), nodes, root)
    motion = _motion(str(path), nodes, kept, rows)
    return demand_finite(motion.noted(*rows.notes, *notes))


def _hierarchy(tokens: Tokens) -> list[_Node]:
    """The trees, parents first; End Sites are nodes named after their parent."""
    tokens.take("HIERARCHY")
    nodes: list[_Node] = []
    open_nodes: list[int] = []
    while tokens.peek() or open_nodes or not nodes:
        line, word = tokens.line, tokens.take().lower()
        if word == "}" and open_nodes:
            open_nodes.pop()
            continue
        inside = bool(open_nodes)
        if word not in ("joint", "end") if inside else word != "root":
            raise MotionError(tokens.path, f"unexpected {word[:40]!r}", line)
        parent = open_nodes[-1] if inside else -1
        nodes.append(_node(tokens, word, parent, nodes))
        open_nodes.append(len(nodes) - 1)
        if len(nodes) > MAX_NODES:
            raise MotionError(tokens.path, f"more than {MAX_NODES} joints", line)
    return nodes


def _node(tokens: Tokens, kind: str, parent: int, nodes: list[_Node]) -> _Node:
    """One node, up to where its children begin."""
    line, words = tokens.line, []
    while tokens.peek() != "{":
        words.append(tokens.take())
        if len(words) > 20:
            raise MotionError(tokens.path, "a joint without its '{'", line)
    tokens.take("{")
    name = f"{nodes[parent].name}_end" if kind == "end" else " ".join(words)
    if not name:
        raise MotionError(tokens.path, "a joint without a name", line)
    tokens.take("OFFSET")
    offset = tokens.numbers(3)
    channels: list[tuple[str, str]] = []
    if tokens.peek().lower() == "channels":
        tokens.take()
        line, count = tokens.line, tokens.number()
        if count not in range(7):
            raise MotionError(tokens.path, f"{count:g} channels, not 0 to 6", line)
        channels = [_channel(tokens) for _ in range(int(count))]
        if len(set(channels)) != len(channels):
            raise MotionError(tokens.path, "a channel is listed twice", line)
    return _Node(name, parent, offset, tuple(channels))


def _channel(tokens: Tokens) -> tuple[str, str]:
    line, word = tokens.line, tokens.take()
    match = _CHANNEL.fullmatch(word)
    if match is None:
        raise MotionError(tokens.path, f"unknown channel {word[:40]!r}", line)
    return match[2].lower(), match[1].lower()


def _figure(
    path: str, nodes: list[_Node], wanted: str | None
) -> tuple[list[int], tuple[str, ...]]:
    """The nodes of the tree that is a figure, and what to tell about the others.

    Raises:
        MotionError: there are several figures, or none has the wanted name.
    """
    trees: dict[int, list[int]] = {}
    roots: list[int] = []
    for index, node in enumerate(nodes):
        roots.append(index if node.parent < 0 else roots[node.parent])
        trees.setdefault(roots[index], []).append(index)
    names = {root: nodes[root].name for root in trees}
    if wanted is not None:
        found = [root for root, name in names.items() if name == wanted]
    else:
        found = [r for r, t in trees.items() if len(t) >= FEWEST] or [0]
    if len(found) != 1:
        listed = ", ".join(names.values())
        raise MotionError(path, f"which ROOT of {listed} is meant? say --root NAME")
    others = [name for root, name in names.items() if root != found[0]]
    note = f"left out what is no part of the figure: {', '.join(others)}"
    return trees[found[0]], (note,) if others else ()


def _motion(path: str, nodes: list[_Node], kept: list[int], rows: Rows) -> Motion:
    """Applies the channels of the nodes that are kept."""
    starts = np.cumsum([0, *(len(node.channels) for node in nodes)])
    local, places = [], {}
    for place, index in enumerate(kept):
        node = nodes[index]
        values = rows.values[:, starts[index] : starts[index + 1]]
        local.append(_turn(node, values))
        shift = _shift(node, values)
        if shift is not None:
            places[place] = shift
    parents = tuple(
        kept.index(nodes[i].parent) if nodes[i].parent >= 0 else -1 for i in kept
    )
    offsets = np.stack([nodes[index].offset for index in kept])
    root = places.pop(0, np.tile(offsets[0], (len(rows.values), 1)))
    offsets[0] = 0.0
    for place, shift in places.items():
        offsets[place] = np.median(shift, axis=0)
    names, notes = _unique([nodes[index].name for index in kept])
    return Motion(
        path=path,
        names=names,
        parents=parents,
        offsets=offsets,
        root=root,
        quats=world_rotations(parents, local),
        fps=rows.fps,
        notes=notes,
        moves={k: shift for k, shift in places.items() if np.ptp(shift, axis=0).any()},
    )


def _turn(node: _Node, values: np.ndarray) -> Rotation:
    """Rotations [T] of a joint: the product of its channels as listed."""
    turning = [kind == "rotation" for kind, _ in node.channels]
    if not any(turning):
        return Rotation.identity(len(values))
    order = "".join(axis for kind, axis in node.channels if kind == "rotation")
    return Rotation.from_euler(order.upper(), values[:, turning], degrees=True)


def _shift(node: _Node, values: np.ndarray) -> np.ndarray | None:
    """Where a joint is in its parent's frame [T, 3]; None: always at its OFFSET.

    Position channels stand for the OFFSET in most programs, in some they are added to
    it: these stay near zero where a bone is long.
    """
    columns = {
        "xyz".index(axis): values[:, column]
        for column, (kind, axis) in enumerate(node.channels)
        if kind == "position"
    }
    if not columns:
        return None
    shift = np.tile(node.offset, (len(values), 1))
    for axis, column in columns.items():
        shift[:, axis] = column
    middle = np.median(shift, axis=0)
    apart = np.linalg.norm(middle - node.offset)
    if node.parent >= 0 and np.linalg.norm(middle) < min(apart, 1e-3 + 0.5 * apart):
        return node.offset + shift
    return shift


def _unique(names: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names with a number added to those that occurred before, and a note."""
    seen: Counter[str] = Counter()
    out = []
    for name in names:
        seen[name] += 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    twice = [n for n, k in seen.items() if k > 1 and not n.endswith("_end")]
    note = f"several joints are called {', '.join(twice[:10])}"
    return tuple(out), (note,) if twice else ()
