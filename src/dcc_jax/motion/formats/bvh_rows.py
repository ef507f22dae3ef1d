"""The MOTION section of a BVH file: how many rows, how fast, and their numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.text import all_numbers, number, rate_of

_HEAD = re.compile(
    r"\s*MOTION\s+Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)", re.IGNORECASE
)


NEARLY = 0.75  # of a row: so much of the last one is worth completing


@dataclass(frozen=True, eq=False)
class Rows:
    """The numbers [T, channels] of a MOTION section."""

    values: np.ndarray
    fps: float
    notes: tuple[str, ...]


def read_rows(
    path: str | Path, text: str, line: int, channels: int, fps: float | None
) -> Rows:
    """The rows of a MOTION section.

    A row more or less than claimed is common, and so is a file cut within its last
    row: what is there is taken, with a note. A last row that is nearly whole is
    completed from the row before.

    Args:
        path: of the file.
        text: from the word MOTION on.
        line: of that word.
        channels: numbers in a row.
        fps: the frame rate if the caller knows it; the file's is then not read.

    Raises:
        MotionError: anything wrong with the section.
    """
    head = _HEAD.match(text)
    if head is None:
        raise MotionError(path, "MOTION lacks 'Frames:' or 'Frame Time:'", line)
    claimed = number(path, head[1], line + 1)
    if claimed < 1 or claimed != int(claimed):
        raise MotionError(path, f"claims {head[1][:40]} frames", line + 1)
    if not channels:
        raise MotionError(path, "no joint has a channel: there is no motion", line)
    fps = fps or _rate(path, head[2], line + 2)
    line += text.count("\n", 0, head.end())
    body = text[head.end() :]
    values = all_numbers(path, body, line)
    count = int(claimed)
    if len(values) == count * channels:
        return Rows(values.reshape(count, channels), fps, ())
    values, notes = _uneven(path, body, line, channels, values)
    if not count <= 2 * len(values) <= 4 * count:
        reason = f"claims {head[1][:40]} frames of {channels} numbers, holds "
        raise MotionError(path, reason + str(len(values)), line)
    if count != len(values):
        notes += (f"claims {count} frames, holds {len(values)}: those were taken",)
    return Rows(values, fps, notes)


def _rate(path: str | Path, token: str, line: int) -> float:
    seconds = number(path, token, line)
    if not 1e-4 <= seconds <= 1.0:
        reason = f"frame time {token[:40]} s is not credible; say --source-fps"
        raise MotionError(path, reason, line)
    return rate_of(token, seconds)


def _uneven(
    path: str | Path, text: str, line: int, channels: int, values: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Rows [T, channels] where not as many numbers are there as claimed, and notes.

    A number that is lost in the middle would shift all that follow: every line but the
    last must be a row.

    Raises:
        MotionError: a line that is no row.
    """
    rows = [(at, len(row.split())) for at, row in enumerate(text.split("\n"), line)]
    rows = [(at, size) for at, size in rows if size]
    for at, size in rows:
        if size > channels or (size < channels and at != rows[-1][0]):
            raise MotionError(path, f"a row of {size} numbers, not {channels}", at)
    whole, rest = divmod(len(values), channels)
    table = values[: whole * channels].reshape(whole, channels)
    if not rest:
        return table, ()
    # A number that the text ends in may have lost its digits.
    rest -= not text[-1].isspace()
    if whole and rest >= NEARLY * channels:
        last = np.concatenate([values[whole * channels :][:rest], table[-1, rest:]])
        note = f"the last row is cut: {channels - rest} numbers are of the one before"
        return np.concatenate([table, last[None]]), (note,)
    return table, ("the last row is cut: left out",)
