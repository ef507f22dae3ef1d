"""`dcc-jax render RUN_DIR`: a video of a trained policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from dcc_jax import command
from dcc_jax.play import overrides

if TYPE_CHECKING:
    from dcc_jax.render.film import FilmPlan

PROGRAM = "dcc_jax.render"


@dataclass(frozen=True)
class Options:
    """Films a trained policy's mean action.

    Arrows are the forces passed to the compliance controller; the ghost is the pose
    without the displacement u.

    Exit status: 0 done; 2 a bad argument; 1 a failure."""

    run_dir: Annotated[Positional[str], arg(metavar="RUN_DIR")]
    """A run directory, or the name of a policy that ships."""

    out: Annotated[
        Path | None,
        arg(
            metavar="FILE.mp4|FILE.gif",
            help_behavior_hint="(default: RUN_DIR.mp4, without --strip and --gif)",
        ),
    ] = None
    """The video, 1280 x 720."""

    gif: Annotated[
        Path | None, arg(metavar="FILE.gif", help_behavior_hint="(default: none)")
    ] = None
    """The same as a small looping picture, 480 wide."""

    seconds: Annotated[float, arg(metavar="S")] = 8.0
    """How long the policy plays."""

    slow: Annotated[float, arg(metavar="TIMES")] = 1.0
    """Slow motion: how many times slower than real."""

    camera: Annotated[
        tuple[float, ...],
        arg(metavar="A [E [D]]", help_behavior_hint="(default: the task's)"),
    ] = ()
    """Azimuth in degrees (90 looks to the left, 180 from the front), elevation in
    degrees (-12 looks down a little), distance in m."""

    alpha: Annotated[
        float | None,
        arg(metavar="A", help_behavior_hint="(default: the greatest of the training)"),
    ] = None
    """Level of compliance."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Of everything that is drawn."""

    task: overrides.TaskParameters = ()

    strip: Annotated[
        Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")
    ] = None
    """Frames side by side on one page."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(PROGRAM, argv, partial(overrides.read, PROGRAM, Options), _plan)


def _plan(options: Options) -> command.Work:
    command.start_jax()
    from dcc_jax.render import film

    task = overrides.changes(PROGRAM, options.run_dir, options.task)
    arguments: dict[str, Any] = {**vars(options), "task": task}
    return partial(_film, film.prepare(**arguments))


def _film(plan: FilmPlan) -> None:
    from rich.console import Console
    from rich.progress import track

    from dcc_jax.render import film

    shot = film.play(plan)
    if shot.falls:
        print(f"{shot.falls} falls: where one episode ends the next one begins")
    console = Console(stderr=True)
    drawn = track(shot.images, "drawing", total=shot.count, console=console)
    film.write(plan, dataclasses.replace(shot, images=iter(drawn)))
    for path in (plan.out, plan.gif, plan.strip):
        if path is not None:
            print(f"wrote {path}")


if __name__ == "__main__":
    command.leave(main())
