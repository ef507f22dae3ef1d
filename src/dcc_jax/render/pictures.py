"""Motions of a scene as pictures: forces as arrows, u as a ghost.

Letters: T frames, one a control step, F forces.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import jax
import mujoco
import numpy as np
from PIL import Image

from dcc_jax.env.environment import Environment
from dcc_jax.env.task import Task
from dcc_jax.play.recording import Motion, displaced
from dcc_jax.viz import draw

LONGEST_ARROW = 0.7  # m, of the largest force in the video
ECHO = 6  # frames in which the arrow of a force fades: a ball touches for one or two


def pictures(
    environment: Environment,
    motion: Motion,
    episodes: np.ndarray,
    *,
    arrows: Sequence[Sequence[draw.Arrow]],
    captions: list[str],
    view: draw.View,
    size: tuple[int, int],
    slow: float = 1.0,
) -> Iterator[np.ndarray]:
    """One picture a control step, or more of them in slow motion.

    Args:
        environment: where it happened.
        motion: what happened [T, ...].
        episodes: of each frame [T]; between two of them nothing moves.
        arrows: of each frame.
        captions: likewise.
        view: where the camera is.
        size: width and height in pixels.
        slow: how many times slower than real.
    """
    model = environment.scene.model
    at = moments(len(episodes), slow)
    now = at.astype(int)
    mocap = motion.mocap_pos, motion.mocap_quat
    return draw.frames(
        model,
        between(model, np.asarray(motion.qpos), episodes, at),
        camera=view,
        size=size,
        ghost_qpos=between(model, displaced(environment, motion), episodes, at),
        arrows=[arrows[i] for i in now],
        captions=[captions[i] for i in now],
        mocap=jax.tree.map(lambda x: np.asarray(x)[now], mocap),
    )


def moments(count: int, slow: float) -> np.ndarray:
    """Which moments of so many frames a film shows, in frames."""
    return np.arange(0.0, count, 1.0 / slow)


def between(
    model: mujoco.MjModel, qpos: np.ndarray, episodes: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Coordinates at moments between the frames [T, nq], along the shortest way."""
    found, velocity = [], np.empty(model.nv)
    for moment in at:
        now = int(moment)
        later = min(now + 1, len(qpos) - 1)
        q = qpos[now].astype(float)
        if moment > now and episodes[later] == episodes[now]:
            mujoco.mj_differentiatePos(model, velocity, 1.0, q, qpos[later])
            mujoco.mj_integratePos(model, q, velocity, moment - now)
        found.append(q)
    return np.array(found)


def view_of(task: Task, camera: Sequence[float] = (), still: bool = False) -> draw.View:
    """Where the camera is; it lags behind in a video, not on a page of pictures.

    Args:
        task: whose own view counts for what `camera` leaves open.
        camera: azimuth, elevation, distance, or the first of them.
        still: for a page of pictures.
    """
    view = draw.View(
        azimuth=task.camera_azimuth,
        distance=task.camera_distance,
        height=task.camera_height,
    )
    names = ("azimuth", "elevation", "distance")
    view = dataclasses.replace(view, **dict(zip(names, camera, strict=False)))
    return dataclasses.replace(view, smooth=0.0) if still else view


def arrows(
    motion: Motion, times: np.ndarray, episodes: np.ndarray
) -> list[list[draw.Arrow]]:
    """Of each frame. A force fades over `ECHO` frames, so that one can see it; the
    largest that is seen is `LONGEST_ARROW` long.

    Args:
        motion: of all episodes [T, N, ...].
        times: control step of each frame.
        episodes: likewise.
    """
    force, point = np.asarray(motion.force_w), np.asarray(motion.point_w)
    size = np.linalg.norm(force, axis=-1)
    frames, largest = [], 1e-6
    for time, episode in zip(times, episodes, strict=True):
        begin = max(0, time - ECHO + 1)
        recent = size[begin : time + 1, episode]  # [at most ECHO, F]
        fading = 1.0 - (len(recent) - 1 - np.arange(len(recent))) / ECHO
        faded = recent * fading[:, None]
        largest = max(largest, float(faded.max()))
        last = faded.argmax(axis=0)
        frames.append(
            [
                (
                    point[begin + at, episode, f],
                    fading[at] * force[begin + at, episode, f],
                )
                for f, at in enumerate(last)
            ]
        )
    scale = LONGEST_ARROW / largest
    return [[(at, scale * shaft) for at, shaft in frame] for frame in frames]


def caption(
    name: str, alpha: float, seconds: float, numbers: Mapping[str, float]
) -> str:
    """A line of text over a picture."""
    return (
        f"{name}  alpha {alpha:g}  {seconds:.2f} s"
        f"  force {numbers['force_peak']:.0f} N"
        f"  u {np.degrees(numbers['displacement']):.1f} deg"
        f"  {100 * numbers['root_displacement']:.1f} cm"
    )


def evenly(count: int, wanted: int) -> np.ndarray:
    """Indices of so many frames, or fewer, from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


def shrunk(image: np.ndarray, width: int) -> np.ndarray:
    """A picture of another width, its edges soft."""
    height = round(image.shape[0] * width / image.shape[1])
    small = Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS)
    return np.asarray(small)


def sheet(images: list[np.ndarray], across: int) -> np.ndarray:
    """Pictures of one size side by side, `across` in a row, white at the end."""
    blank = np.full_like(images[0], 255)
    filled = images + [blank] * (-len(images) % across)
    rows = [
        np.concatenate(filled[i : i + across], axis=1)
        for i in range(0, len(filled), across)
    ]
    return np.concatenate(rows)
