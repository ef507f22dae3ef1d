"""`python -m dcc_jax.render RUN_DIR`: a video of a trained policy."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dcc_jax import command

if TYPE_CHECKING:
    from dcc_jax.render.film import FilmPlan

PROGRAM = "dcc_jax.render"
_DESCRIPTION = """Films a trained policy's mean action. Arrows are the forces that the
compliance hears, the ghost shows the displacement u. Exit status: 0 done; 2 a bad
argument; 1 a failure."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(_parser(), argv, _plan, _run)


def _parser() -> command.Parser:
    parser = command.Parser(prog=f"python -m {PROGRAM}", description=_DESCRIPTION)
    add = parser.add_argument
    add(
        "run_dir",
        metavar="RUN_DIR",
        help="a run directory, or the name of a policy that ships",
    )
    add(
        "--out",
        type=Path,
        metavar="FILE.mp4",
        help="the video; without it and --strip, <name of the run>.mp4",
    )
    add("--seconds", type=float, default=8.0, metavar="S", help="of the video (8)")
    add("--alpha", type=float, metavar="A", help="compliance (the training's greatest)")
    add("--seed", type=int, default=0, metavar="N", help="of all that is drawn (0)")
    add("--strip", type=Path, metavar="FILE.png", help="frames on one page")
    return parser


def _plan(options: argparse.Namespace) -> FilmPlan:
    from dcc_jax.render import film

    return film.prepare(**vars(options), task=None)


def _run(plan: FilmPlan, _: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import track

    from dcc_jax.render import film

    shot = film.play(plan)
    if shot.falls:
        print(f"{shot.falls} falls: where one episode ends the next one begins")
    console = Console(stderr=True)
    film.write(plan, track(shot.images, "drawing", total=shot.count, console=console))
    for path in (plan.out, plan.strip):
        if path is not None:
            print(f"wrote {path}")


if __name__ == "__main__":
    command.leave(main())
