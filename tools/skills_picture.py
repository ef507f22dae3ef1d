"""Writes `docs/skills.png`: one moment of each skill, cut from the strips in results.

`python -m tools.skills_picture` after new strips have been rendered.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread, imsave

DOCS = Path(__file__).resolve().parents[1] / "docs"
ACROSS, DOWN = 4, 3  # pictures of a strip
MOMENTS = {
    "push": (2, 1),
    "trampoline": (0, 3),
    "backflip": (0, 3),
    "door": (2, 0),
    "hand-in-hand": (2, 2),
    "ball": (1, 0),
    "chicken-fight": (1, 3),
    "sustained-push": (2, 0),
    "locomotion": (1, 0),
}
"""Row and column in the strip of each skill, chosen by eye."""


def moment(skill: str) -> np.ndarray:
    """The chosen picture [H, W, 3] of a skill's strip."""
    strip = imread(DOCS / "results" / f"{skill}.png")[..., :3]
    height, width = strip.shape[0] // DOWN, strip.shape[1] // ACROSS
    row, column = MOMENTS[skill]
    return strip[row * height : (row + 1) * height, column * width :][:, :width]


def main() -> None:
    """Three rows of three."""
    pictures = [moment(skill) for skill in MOMENTS]
    rows = [np.concatenate(pictures[i : i + 3], axis=1) for i in (0, 3, 6)]
    imsave(DOCS / "skills.png", np.concatenate(rows))


if __name__ == "__main__":
    main()
