"""Three skills side by side in a small loop: what the README opens with.

python experiments/readme_loop.py [--out docs/skills.gif]
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from pathlib import Path

import numpy as np

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.render import film, pictures
from dcc_jax.viz import files

SKILLS = {
    "door": ((20.0, -10.0, 3.6), 0),
    "ball": ((125.0, -4.0, 4.2), 1),
    "hand-in-hand": ((150.0, -8.0, 3.8), 3),
}
"""Camera (azimuth and elevation in degrees, distance in m) and seed of each."""
SECONDS = 5.0
WIDTH = 320  # pixels, of each
RATE = 15.0  # pictures a second


def shown(name: str, camera: tuple[float, ...], seed: int) -> list[np.ndarray]:
    """The pictures of a skill at its greatest alpha."""
    gif = Path(f"{name}.gif")  # is not written; it says that nothing else is
    plan = film.prepare(name, seconds=SECONDS, seed=seed, gif=gif, camera=camera)
    plan = dataclasses.replace(plan, size=(2 * WIDTH, 2 * WIDTH))
    every = round(CONTROL_RATE / RATE)
    images = itertools.islice(film.play(plan).images, 0, None, every)
    return [pictures.shrunk(image, WIDTH) for image in images]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/skills.gif"))
    options = parser.parse_args()
    rows = [shown(name, *view) for name, view in SKILLS.items()]
    together = (np.concatenate(images, axis=1) for images in zip(*rows, strict=True))
    files.write_gif(options.out, together, RATE)
    print(f"wrote {options.out}, {options.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    command.script(main)
