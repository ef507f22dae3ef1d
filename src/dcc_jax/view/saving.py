"""The last ten seconds as a film or as a clip."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

from dcc_jax.character import Character
from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.motion.clip import Clip, join_qpos, save_clip, split_qpos
from dcc_jax.play.simulation import Moment, Simulation
from dcc_jax.render import pictures
from dcc_jax.render.film import GIF_RATE, GIF_WIDTH, SIZE
from dcc_jax.viz import files


def save(
    simulation: Simulation,
    moments: Sequence[Moment],
    kind: str,
    alpha: float,
    folder: Path,
) -> Path:
    """Writes a file; returns where it is.

    Args:
        simulation: where it happened.
        moments: what happened.
        kind: `mp4`, `gif` or `npz`, the clip.
        alpha: for the captions.
        folder: made where it is missing.

    Raises:
        ValueError: nothing has happened yet.
        MotionError: it makes no clip.
        ModuleNotFoundError: a film needs the `video` extra.
    """
    if not moments:
        raise ValueError("nothing has happened yet")
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    path = folder / f"{simulation.task.name}-{stamp}.{kind}"
    if kind == "npz":
        save_clip(path, clip(simulation, moments))
        return path
    if kind == "gif":
        every, (width, height) = round(CONTROL_RATE / GIF_RATE), SIZE
        size = 2 * GIF_WIDTH, 2 * GIF_WIDTH * height // width
        images = film(simulation, moments[::every], alpha, size)
        small = (pictures.shrunk(image, GIF_WIDTH) for image in images)
        files.write_gif(path, small, GIF_RATE)
    else:
        files.write_mp4(path, film(simulation, moments, alpha, SIZE), CONTROL_RATE)
    return path


def clip(simulation: Simulation, moments: Sequence[Moment]) -> Clip:
    """The character's motion since the last reset, as a clip.

    Raises:
        ValueError: fewer than two control steps.
    """
    last = [m for m in moments if m.episode == moments[-1].episode]
    if len(last) < 2:
        raise ValueError("a clip needs two control steps of one episode")
    qpos = np.stack([np.asarray(m.motion.qpos) for m in last])
    begin = simulation.environment.scene.qpos_adr
    position, quats = split_qpos(qpos[:, begin : begin + Character.nq])
    return Clip(
        qpos=join_qpos(position, quats),
        fps=float(CONTROL_RATE),
        name=f"{simulation.task.name} {time.strftime('%Y-%m-%d %H:%M:%S')}",
        source=f"simulated by dcc_jax, policy {simulation.run.name}",
        licence="of the policy",
    )


def film(
    simulation: Simulation,
    moments: Sequence[Moment],
    alpha: float,
    size: tuple[int, int],
) -> Iterator[np.ndarray]:
    """A picture of every moment."""
    motion = jax.tree.map(lambda *rows: np.stack(rows), *[m.motion for m in moments])
    name = simulation.task.name
    captions = [
        f"{pictures.caption(name, alpha, m.time, m.numbers)}  {m.ended}"
        for m in moments
    ]
    # Each episode is a column of its own: no arrow outlives its episode.
    episodes = np.array([m.episode - moments[0].episode for m in moments])
    columns = jax.tree.map(
        lambda x: np.repeat(x[:, None], episodes[-1] + 1, axis=1), motion
    )
    begun = episodes[None] == np.arange(episodes[-1] + 1)[:, None]
    force = np.where(begun.T[..., None, None], columns.force_w, 0.0)
    return pictures.pictures(
        simulation.environment,
        motion,
        episodes,
        arrows=pictures.arrows(
            columns.replace(force_w=force), np.arange(len(moments)), episodes
        ),
        captions=captions,
        view=pictures.view_of(simulation.task),
        size=size,
    )
