"""Episodes of a policy as pictures: forces as arrows, u as a ghost.

Letters: T frames, one a control step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.image import imsave

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.env.task import Task
from dcc_jax.play.player import Player
from dcc_jax.play.recording import Motion, Recording, displaced
from dcc_jax.play.runs import Run, find_run, make_environment
from dcc_jax.viz import draw

EPISODES = 8  # played at once; the next one begins where one ends by a fall
AFTERMATH = 6  # frames that a fall is still followed; only soles meet the ground
LONGEST_ARROW = 0.7  # m, of the largest force in the video
ECHO = 6  # frames in which the arrow of a force fades: a ball touches for one or two
SHEET = (4, 3)  # pictures across and down


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
) -> None:
    """Films the mean action of a policy.

    Args:
        run_dir: a run directory, or a policy that ships.
        out: the mp4; None: `<name of the run>.mp4`, or none where there is a strip.
        seconds: of the video; after a fall the next episode follows.
        alpha: level of compliance; None: the greatest of the training.
        seed: of everything that is drawn.
        strip: a picture of frames side by side.
        task: other parameters of the run's task, `{"width": 1.5}`, or another task.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
        ModuleNotFoundError: the `video` extra is not installed.
    """
    plan = prepare(run_dir, out, seconds, alpha, seed, strip, task)
    write(plan, play(plan).images)


def prepare(
    run_dir: str | Path,
    out: str | Path | None,
    seconds: float,
    alpha: float | None,
    seed: int,
    strip: str | Path | None,
    task: Mapping[str, Any] | Task | None,
) -> FilmPlan:
    """Checks everything a user can get wrong; arguments as of `render`."""
    if not 0.1 <= seconds <= 3600.0:
        raise ValueError(f"seconds must be in [0.1, 3600], got {seconds}")
    if alpha is not None and not 0.0 <= alpha <= 1.0:
        raise ValueError(f"alpha must be in [0, 1], got {alpha}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed must be between 0 and 2^32 - 1, got {seed}")
    run = find_run(run_dir)
    if out is None and strip is None:
        out = f"{Path(run.name).resolve().name}.mp4"
    if out is not None:
        _check_ending("out", out, ".mp4")
        draw.check_video(out)
    if strip is not None:
        _check_ending("strip", strip, ".png")
    return FilmPlan(
        run=run,
        player=Player(make_environment(run, task)),
        alpha=run.alphas[1] if alpha is None else alpha,
        seconds=seconds,
        seed=seed,
        out=None if out is None else Path(out),
        strip=None if strip is None else Path(strip),
    )


def _check_ending(name: str, path: str | Path, ending: str) -> None:
    if Path(path).suffix.lower() != ending:
        raise ValueError(f"{name} must end in {ending}, got {path}")
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
    if plan.out is None:
        chosen = _evenly(len(times), SHEET[0] * SHEET[1])
        times, episodes = times[chosen], episodes[chosen]
    images = _images(plan, recording, times, episodes)
    return Shot(images, len(times), int(recording.fell[np.unique(episodes)].sum()))


def write(plan: FilmPlan, images: Iterable[np.ndarray]) -> None:
    """Writes the video and the page of pictures that were asked for."""
    kept: list[np.ndarray] = []
    if plan.out is None:
        kept = list(images)
    else:
        draw.write_mp4(plan.out, _kept(images, kept), CONTROL_RATE)
    if plan.strip is not None:
        chosen = _evenly(len(kept), SHEET[0] * SHEET[1])
        imsave(plan.strip, sheet([kept[i] for i in chosen], SHEET[0]))


def sheet(images: list[np.ndarray], across: int) -> np.ndarray:
    """Pictures of one size side by side, `across` in a row, white at the end."""
    blank = np.full_like(images[0], 255)
    filled = images + [blank] * (-len(images) % across)
    rows = [
        np.concatenate(filled[i : i + across], axis=1)
        for i in range(0, len(filled), across)
    ]
    return np.concatenate(rows)


def _kept(images: Iterable[np.ndarray], kept: list[np.ndarray]) -> Iterator[np.ndarray]:
    for image in images:
        kept.append(image)
        yield image


def _evenly(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


def _cut(recording: Recording, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Control step [T] and episode [T] of each frame: one episode after another."""
    steps, frames = len(recording.alive), []
    for episode, lasting in enumerate(recording.alive.sum(axis=0).tolist()):
        shown = min(steps, lasting + AFTERMATH * recording.fell[episode])
        frames += [(step, episode) for step in range(shown)]
    times, episodes = np.array(frames[:count]).T
    return times, episodes


def _images(
    plan: FilmPlan, recording: Recording, times: np.ndarray, episodes: np.ndarray
) -> Iterator[np.ndarray]:
    environment = plan.player.environment
    assert recording.motion is not None
    motion = jax.tree.map(lambda x: x[times, episodes], recording.motion)
    return draw.frames(
        environment.scene.model,
        motion.qpos,
        camera=_view(environment.task, still=plan.out is None),
        ghost_qpos=displaced(environment, motion),
        arrows=_arrows(recording.motion, times, episodes),
        captions=_captions(plan, recording, times, episodes),
        mocap=(motion.mocap_pos, motion.mocap_quat),
    )


def _view(task: Task, still: bool) -> draw.View:
    """Where the camera is; it lags behind in a video, not on a page of pictures."""
    view = draw.View(
        azimuth=task.camera_azimuth,
        distance=task.camera_distance,
        height=task.camera_height,
    )
    return dataclasses.replace(view, smooth=0.0) if still else view


def _arrows(
    motion: Motion, times: np.ndarray, episodes: np.ndarray
) -> list[list[draw.Arrow]]:
    """Of each frame. A force fades over `ECHO` frames, so that one can see it."""
    force, point = np.asarray(motion.force_w), np.asarray(motion.point_w)
    size = np.linalg.norm(force, axis=-1)
    scale = LONGEST_ARROW / max(float(size[times, episodes].max()), 1e-6)
    frames = []
    for time, episode in zip(times, episodes, strict=True):
        begin = max(0, time - ECHO + 1)
        recent = size[begin : time + 1, episode]  # [at most ECHO, F]
        fading = 1.0 - (len(recent) - 1 - np.arange(len(recent))) / ECHO
        faded = recent * fading[:, None]
        last = faded.argmax(axis=0)
        frames.append(
            [
                (
                    point[begin + at, episode, f],
                    scale * fading[at] * force[begin + at, episode, f],
                )
                for f, at in enumerate(last)
            ]
        )
    return frames


def _captions(
    plan: FilmPlan, recording: Recording, times: np.ndarray, episodes: np.ndarray
) -> list[str]:
    numbers = {name: x[times, episodes] for name, x in recording.numbers.items()}
    alive = recording.alive[times, episodes]
    head = f"{plan.player.environment.task.name}  alpha {plan.alpha:g}"
    return [
        f"{head}  {(time + 1) / CONTROL_RATE:.2f} s"
        f"  force {numbers['force_peak'][i]:.0f} N"
        f"  u {np.degrees(numbers['displacement'][i]):.1f} deg"
        f"  {100 * numbers['root_displacement'][i]:.1f} cm"
        f"{'' if alive[i] else '  fell'}"
        for i, time in enumerate(times)
    ]
