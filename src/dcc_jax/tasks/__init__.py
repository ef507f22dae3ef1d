"""The skills of the paper by name, and the environments they make."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from dcc_jax.character import asset_path, load_character
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.task import Task
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks.backflip import Backflip
from dcc_jax.tasks.ball import Ball
from dcc_jax.tasks.chicken_fight import ChickenFight
from dcc_jax.tasks.door import Door
from dcc_jax.tasks.hand_in_hand import HandInHand
from dcc_jax.tasks.push import Push
from dcc_jax.tasks.sustained_push import SustainedPush
from dcc_jax.tasks.trampoline import Trampoline

if TYPE_CHECKING:
    from dcc_jax.config import Config

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        Push,
        SustainedPush,
        Trampoline,
        Backflip,
        HandInHand,
        ChickenFight,
        Door,
        Ball,
    )
}


def make_task(name: str) -> Task:
    """The task called `name`, with its defaults.

    Raises:
        ValueError: there is none; the message lists them.
    """
    if name not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {name!r}")
    return TASKS[name]()


def make_environment(config: Config, task: Task | None = None) -> Environment:
    """The environment that a configuration describes.

    Args:
        config: of the run.
        task: in place of the one that it names, e.g. with other parameters.

    Raises:
        ValueError: an unknown task.
        MotionError: a clip that cannot be read.
    """
    task = make_task(config.task) if task is None else task
    return Environment(
        task,
        load_character(config.env.mass),
        make_references(_clips(task, config.env)),
        config.env,
    )


def _clips(task: Task, config: EnvConfig) -> list[Clip]:
    if config.clips:
        return [load_clip(_clip_path(clip)) for clip in config.clips]
    return [load_clip(_clip_path(clip)) for clip in task.clips]


def _clip_path(clip: str) -> Path:
    """A file `*.npz` where it is, any other name among the package's own clips."""
    path = Path(clip)
    return path if path.suffix == ".npz" else asset_path(f"motions/{clip}.npz")
