"""Biovision hierarchies (`.bvh`): HIERARCHY with offsets and channels, then MOTION."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
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
from dcc_jax.motion.formats.text import Tokens, number, read_text

_CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)


@dataclass(frozen=True)
class _Node:
    """One joint or end site; `channels` are such as ('position', 'x')."""

    name: str
    parent: int
    offset: np.ndarray  # [3], the file's unit
    channels: tuple[tuple[str, str], ...] = ()


def is_bvh(head: str) -> bool:
    """Whether a text that begins like this is a BVH file."""
    return head.lstrip().upper().startswith("HIERARCHY")


def read_bvh(path: str | Path) -> Motion:
    """Reads a BVH file, in its own axes and unit.

    Rotations are products of the channels in the order each joint lists them. Where
    the root has position channels they alone place it; its OFFSET is then ignored,
    since exporters disagree about what it means. A first row that only shows the
    zero pose is dropped.

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
    rows, fps = _rows(path, text[found.start() :], first_line, channels)
    return demand_finite(_without_rest_row(_motion(str(path), nodes, rows, fps)))


def _hierarchy(tokens: Tokens) -> list[_Node]:
    """The tree, parents first; End Sites are nodes named after their parent."""
    tokens.take("HIERARCHY")
    nodes: list[_Node] = []
    open_nodes: list[int] = []
    while True:
        line, word = tokens.line, tokens.take().lower()
        if word == "}":
            if not open_nodes:
                raise MotionError(tokens.path, "a brace closes nothing", line)
            open_nodes.pop()
            if not open_nodes:
                break
            continue
        parent = open_nodes[-1] if open_nodes else -1
        if word not in ("joint", "end") and not (word == "root" and not nodes):
            raise MotionError(tokens.path, f"unexpected {word[:40]!r}", line)
        if word != "root" and parent < 0:
            raise MotionError(tokens.path, f"{word!r} outside the root", line)
        nodes.append(_node(tokens, word, parent, nodes))
        open_nodes.append(len(nodes) - 1)
        if len(nodes) > MAX_NODES:
            raise MotionError(tokens.path, f"more than {MAX_NODES} joints", line)
    if tokens.peek():
        reason = f"{tokens.peek()[:40]!r} after the only root"
        raise MotionError(tokens.path, reason, tokens.line)
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
    if kind != "end" and (not name or any(node.name == name for node in nodes)):
        raise MotionError(tokens.path, f"joint name {name[:40]!r} is not unique", line)
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


def _rows(
    path: str | Path, text: str, line: int, channels: int
) -> tuple[np.ndarray, float]:
    """The numbers [T, channels] of the MOTION section, and the frame rate."""
    head = re.match(
        r"\s*MOTION\s+Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)",
        text,
        re.IGNORECASE,
    )
    if head is None:
        raise MotionError(path, "MOTION lacks 'Frames:' or 'Frame Time:'", line)
    claimed = number(path, head[1], line + 1)
    seconds = number(path, head[2], line + 2)
    if claimed < 1 or claimed != int(claimed):
        raise MotionError(path, f"claims {head[1][:40]} frames", line + 1)
    if not 1e-4 <= seconds <= 1.0:
        raise MotionError(
            path, f"frame time {head[2][:40]} s is not credible", line + 2
        )
    line += text.count("\n", 0, head.end())
    words = text[head.end() :].split()
    if len(words) != int(claimed) * channels:
        raise MotionError(
            path,
            f"claims {int(claimed)} frames of {channels} channels, "
            f"but holds {len(words)} numbers",
            line + text.count("\n", head.end()),
        )
    try:
        values = np.array(words, float)
    except ValueError:
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        tokens = Tokens(path, text[head.end() :], line)
        tokens.numbers(len(words))
    return values.reshape(int(claimed), channels), 1.0 / seconds


def _motion(path: str, nodes: list[_Node], rows: np.ndarray, fps: float) -> Motion:
    """Applies the channels."""
    local, root, column = [], np.zeros((len(rows), 3)), 0
    for node in nodes:
        values = rows[:, column : column + len(node.channels)]
        column += len(node.channels)
        kinds = [kind for kind, _ in node.channels]
        if node.parent < 0:
            root = root + (0.0 if "position" in kinds else node.offset)
            for (kind, axis), value in zip(node.channels, values.T, strict=True):
                if kind == "position":
                    root[:, "xyz".index(axis)] = value
        order = "".join(axis for kind, axis in node.channels if kind == "rotation")
        turn = Rotation.identity(len(rows))
        if order:
            angles = values[:, [kind == "rotation" for kind in kinds]]
            turn = Rotation.from_euler(order.upper(), angles, degrees=True)
        local.append(turn)
    parents = tuple(node.parent for node in nodes)
    offsets = np.stack([node.offset for node in nodes])
    offsets[0] = 0.0
    return Motion(
        path=path,
        names=tuple(_unique([node.name for node in nodes])),
        parents=parents,
        offsets=offsets,
        root=root,
        quats=world_rotations(parents, local),
        fps=fps,
    )


def _unique(names: list[str]) -> list[str]:
    """The names with a number added to those that occurred before."""
    seen: dict[str, int] = {}
    out = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return out


def _without_rest_row(motion: Motion) -> Motion:
    """Drops a first row that is no motion: the root unturned and all else far off."""
    if len(motion.root) < 3:
        return motion
    turns = Rotation.from_quat(motion.quats[:3], scalar_first=True)
    jump = np.median((turns[1].inv() * turns[0]).magnitude())
    step = np.median((turns[2].inv() * turns[1]).magnitude())
    if turns[0].magnitude()[0] > 1e-6 or jump < 0.05 + 20.0 * step:
        return motion
    rest = motion.part(slice(1, None))
    return replace(rest, notes=(*motion.notes, "first frame dropped: a T-pose"))
