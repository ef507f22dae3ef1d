"""Makes our own clips: `python -m tools.author_clips [NAME...]`.

Writes `assets/motions/NAME.npz`, all of them when no name is given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from dcc_jax.motion.clip import save_clip
from tools.author_clips.recipes import author, clip_names

MOTIONS = Path(__file__).resolve().parents[2] / "assets" / "motions"


def main(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = (), out: Path = MOTIONS
) -> None:
    """Writes the named clips, or all of them.

    Args:
        names: clips to make.
        out: folder to write to.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in names or clip_names():
        clip = author(name)
        save_clip(out / f"{name}.npz", clip)
        print(f"{name:14s} {clip.duration:6.2f} s  {len(clip.qpos)} frames")


if __name__ == "__main__":
    tyro.cli(main)
