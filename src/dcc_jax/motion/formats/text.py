"""Reading text formats token by token, with the line of every complaint."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from dcc_jax.motion.formats.npz import MotionError, read_bytes


def read_text(path: str | Path) -> str:
    """The file as Latin-1, which never fails and suits every ASCII format.

    Raises:
        MotionError: it cannot be read, is empty or is not text.
    """
    data = read_bytes(path)
    if not data.strip():
        raise MotionError(path, "the file is empty")
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise MotionError(path, "binary data where text should be", line)
    return data.removeprefix(b"\xef\xbb\xbf").decode("latin-1")


def number(path: str | Path, token: str, line: int) -> float:
    """The finite number a token spells.

    Raises:
        MotionError: it spells none.
    """
    try:
        value = float(token)
    except ValueError:
        raise MotionError(
            path, f"expected a number, got {token[:40]!r}", line
        ) from None
    if not math.isfinite(value):
        raise MotionError(path, f"the number {token[:40]!r} is not finite", line)
    return value


_RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 180, 200, 240, 250, 300, 360)
_FILM = tuple(1000.0 / 1001.0 * rate for rate in (24, 30, 60, 120))  # NTSC
_WORDS_AT_ONCE = 1 << 20  # characters of text that are split into words at a time


def rate_of(token: str, seconds: float) -> float:
    """The frame rate a time between frames stands for.

    `0.033333` is 30 frames a second and not 30.0003, at which the last of 40 frames
    would be lost: a usual rate is meant where the digits allow it.

    Args:
        token: the time as it is written, which tells how far it was rounded.
        seconds: its value.
    """
    digits = token.lower().partition("e")[0].partition(".")[2]
    rounding = 0.5 * 10.0 ** -len(digits) if "e" not in token.lower() else 0.0
    slack = min(max(rounding, 1e-4 * seconds), 0.011 * seconds)
    usual = min((*_RATES, *_FILM), key=lambda rate: abs(1.0 / rate - seconds))
    return float(usual) if abs(1.0 / usual - seconds) <= slack else 1.0 / seconds


def all_numbers(path: str | Path, text: str, first_line: int) -> np.ndarray:
    """The finite numbers a text consists of, [N].

    A part at a time: a list of words takes ten times the memory of the numbers.

    Raises:
        MotionError: a word is no finite number.
    """
    parts, start = [np.zeros(0)], 0
    while start < len(text):
        stop = start + _WORDS_AT_ONCE
        while stop < len(text) and not text[stop].isspace():
            stop += 1
        try:
            part = np.array(text[start:stop].split(), float)
        except ValueError:
            part = np.array([np.nan])
        if not np.isfinite(part).all():
            line = first_line + text.count("\n", 0, start)
            tokens = Tokens(path, text[start:stop], line)
            while tokens.peek():
                tokens.number()
        parts.append(part)
        start = stop
    return np.concatenate(parts)


class Tokens:
    """The words of a text in order; each knows its line."""

    def __init__(self, path: str | Path, text: str, first_line: int = 1) -> None:
        self.path = path
        self._words = [
            (word, line)
            for line, row in enumerate(text.splitlines(), first_line)
            for word in row.split()
        ]
        self._at = 0
        self._last_line = first_line + text.count("\n")

    @property
    def line(self) -> int:
        """The line of the next word."""
        left = self._at < len(self._words)
        return self._words[self._at][1] if left else self._last_line

    def peek(self) -> str:
        """The next word, empty at the end."""
        return self._words[self._at][0] if self._at < len(self._words) else ""

    def take(self, expected: str = "") -> str:
        """The next word, which must be `expected` (in any case) where that is given.

        Raises:
            MotionError: the text ends here, or goes on otherwise.
        """
        word = self.peek()
        if not word:
            raise MotionError(
                self.path, f"ends where {expected or 'more'!r} should follow", self.line
            )
        if expected and word.lower() != expected.lower():
            raise MotionError(
                self.path, f"expected {expected!r}, got {word[:40]!r}", self.line
            )
        self._at += 1
        return word

    def number(self) -> float:
        """The next word as a finite number."""
        line = self.line
        return number(self.path, self.take(), line)

    def numbers(self, count: int) -> np.ndarray:
        """The next `count` words as finite numbers, [count]."""
        return np.array([self.number() for _ in range(count)])
