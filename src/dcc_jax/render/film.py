"""Films of a policy: what is played, checked and written.

Letters: T frames, one a control step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.image import imsave

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.env.task import Task
from dcc_jax.play.player import Player
from dcc_jax.play.recording import Recording
from dcc_jax.play.runs import Run, find_run, make_environment
from dcc_jax.render import pictures
from dcc_jax.viz import files

EPISODES = 8  # played at once; the next one begins where one ends by a fall
AFTERMATH = 6  # frames that a fall is still followed; only soles meet the ground
SHEET = (4, 3)  # pictures across and down
SIZE = (1280, 720)  # pixels, of a film
SHRINK = 2  # a page shows pictures at a share of the film's size, so its edges are soft
GIF_WIDTH, GIF_RATE = 480, 15.0  # pixels, and pictures a second
CAMERA = (130.0, -12.0, 3.4)  # azimuth and elevation in degrees, distance in m
SLOWEST = 16.0


@dataclass(frozen=True)
class FilmPlan:
    """A video that is about to be made: its input is checked."""

    run: Run
    player: Player
    alpha: float
    seconds: float
    seed: int
    out: Path | None
    strip: Path | None
    gif: Path | None = None
    slow: float = 1.0
    camera: tuple[float, ...] = ()
    size: tuple[int, int] = SIZE


@dataclass(frozen=True)
class Shot:
    """What was played, and its pictures, drawn one by one as they are asked for."""

    images: Iterator[np.ndarray]
    count: int
    falls: int


def render(
    run_dir: str | Path,
    out: str | Path | None = None,
    *,
    seconds: float = 8.0,
    alpha: float | None = None,
    seed: int = 0,
    strip: str | Path | None = None,
    task: Mapping[str, Any] | Task | None = None,
    gif: str | Path | None = None,
    camera: Sequence[float] = (),
    slow: float = 1.0,
) -> None:
    """Films the mean action of a policy.

    Args:
        run_dir: a run directory, or a policy that ships.
        out: the mp4; None: `<name of the run>.mp4`, or none where there is a strip or
            a gif.
        seconds: that are played; after a fall the next episode follows.
        alpha: level of compliance; None: the greatest of the training.
        seed: of everything that is drawn.
        strip: a picture of frames side by side.
        task: other parameters of the run's task, `{"width": 1.5}`, or another task.
        gif: a small looping film.
        camera: azimuth and elevation in degrees, distance in m, or the first of them;
            azimuth 90 looks along +y, 180 along -x.
        slow: how many times slower than real.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
        ModuleNotFoundError: the `video` extra is not installed.
    """
    plan = prepare(
        run_dir,
        out=out,
        seconds=seconds,
        alpha=alpha,
        seed=seed,
        strip=strip,
        task=task,
        gif=gif,
        camera=camera,
        slow=slow,
    )
    write(plan, play(plan))


def prepare(
    run_dir: str | Path,
    *,
    out: str | Path | None = None,
    seconds: float = 8.0,
    alpha: float | None = None,
    seed: int = 0,
    strip: str | Path | None = None,
    task: Mapping[str, Any] | Task | None = None,
    gif: str | Path | None = None,
    camera: Sequence[float] = (),
    slow: float = 1.0,
) -> FilmPlan:
    """Checks everything a user can get wrong; arguments as of `render`."""
    if not 0.1 <= seconds <= 3600.0:
        raise ValueError(f"seconds must be in [0.1, 3600], got {seconds}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed must be between 0 and 2^32 - 1, got {seed}")
    camera = tuple(camera)
    _check_camera(camera)
    if not 1.0 <= slow <= SLOWEST:
        raise ValueError(f"slow must be in [1, {SLOWEST:g}], got {slow}")
    run = find_run(run_dir)
    if alpha is not None:
        run.config.env.compliance.check_alpha(alpha)
    if out is None and strip is None and gif is None:
        out = f"{Path(run.name).resolve().name}.mp4"
    if out is not None:
        _check_ending("out", out, ".mp4", ".gif")
        files.check_video(out)
    if strip is not None:
        _check_ending("strip", strip, ".png")
    if gif is not None:
        _check_ending("gif", gif, ".gif")
    return FilmPlan(
        run=run,
        player=Player(make_environment(run, task)),
        alpha=run.alphas[1] if alpha is None else alpha,
        seconds=seconds,
        seed=seed,
        out=None if out is None else Path(out),
        strip=None if strip is None else Path(strip),
        gif=None if gif is None else Path(gif),
        slow=slow,
        camera=camera,
    )


def _check_camera(camera: tuple[float, ...]) -> None:
    azimuth, elevation, distance = (*camera, *CAMERA[len(camera) :])[:3]
    angles = -360.0 <= azimuth <= 360.0 and -90.0 <= elevation <= 90.0
    if len(camera) > 3 or not angles or not 0.1 <= distance <= 100.0:
        raise ValueError(
            "camera must be an azimuth, an elevation in [-90, 90] degrees and a "
            f"distance in [0.1, 100] m, or the first of them, got {list(camera)}"
        )


def _check_ending(name: str, path: str | Path, *endings: str) -> None:
    if Path(path).suffix.lower() not in endings:
        raise ValueError(f"{name} must end in {' or '.join(endings)}, got {path}")
    Path(path).parent.mkdir(parents=True, exist_ok=True)


def play(plan: FilmPlan) -> Shot:
    """Plays as many episodes as fill the video."""
    recording = plan.player.play(
        plan.run,
        range(EPISODES),
        [plan.alpha] * EPISODES,
        seed=plan.seed,
        seconds=plan.seconds,
        motion=True,
    )
    times, episodes = _cut(recording, round(plan.seconds * CONTROL_RATE))
    still = plan.out is None and plan.gif is None
    if still:
        chosen = pictures.evenly(len(times), SHEET[0] * SHEET[1])
        times, episodes = times[chosen], episodes[chosen]
    slow = 1.0 if still else plan.slow
    images = _images(plan, recording, times, episodes, still, slow)
    falls = int(recording.fell[np.unique(episodes)].sum())
    return Shot(images, len(pictures.moments(len(times), slow)), falls)


def write(plan: FilmPlan, shot: Shot) -> None:
    """Writes the video, the gif and the page of pictures that were asked for."""
    small: list[np.ndarray] = []
    page: list[np.ndarray] = []
    chosen = pictures.evenly(shot.count, SHEET[0] * SHEET[1])
    every = round(CONTROL_RATE / GIF_RATE)

    def noted() -> Iterator[np.ndarray]:
        for index, image in enumerate(shot.images):
            if plan.gif is not None and index % every == 0:
                small.append(pictures.shrunk(image, GIF_WIDTH))
            if plan.strip is not None and index in chosen:
                page.append(pictures.shrunk(image, image.shape[1] // SHRINK))
            yield image

    if plan.out is None:
        for _ in noted():
            pass
    else:
        files.write_film(plan.out, noted(), CONTROL_RATE)
    if plan.gif is not None:
        files.write_gif(plan.gif, small, GIF_RATE)
    if plan.strip is not None:
        imsave(plan.strip, pictures.sheet(page, SHEET[0]))


def _cut(recording: Recording, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Control step [T] and episode [T] of each frame: one episode after another."""
    steps, frames = len(recording.alive), []
    for episode, lasting in enumerate(recording.alive.sum(axis=0).tolist()):
        shown = min(steps, lasting + AFTERMATH * recording.fell[episode])
        frames += [(step, episode) for step in range(shown)]
    times, episodes = np.array(frames[:count]).T
    return times, episodes


def _images(
    plan: FilmPlan,
    recording: Recording,
    times: np.ndarray,
    episodes: np.ndarray,
    still: bool,
    slow: float,
) -> Iterator[np.ndarray]:
    environment = plan.player.environment
    assert recording.motion is not None
    motion = jax.tree.map(lambda x: x[times, episodes], recording.motion)
    return pictures.pictures(
        environment,
        motion,
        episodes,
        arrows=pictures.arrows(recording.motion, times, episodes),
        captions=_captions(plan, recording, times, episodes),
        view=pictures.view_of(environment.task, plan.camera, still),
        size=plan.size,
        slow=slow,
    )


def _captions(
    plan: FilmPlan, recording: Recording, times: np.ndarray, episodes: np.ndarray
) -> list[str]:
    numbers = {name: x[times, episodes] for name, x in recording.numbers.items()}
    alive = recording.alive[times, episodes]
    name = plan.player.environment.task.name
    return [
        pictures.caption(
            name,
            plan.alpha,
            (time + 1) / CONTROL_RATE,
            {k: x[i] for k, x in numbers.items()},
        )
        + ("" if alive[i] else "  fell")
        for i, time in enumerate(times)
    ]
