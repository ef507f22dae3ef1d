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
