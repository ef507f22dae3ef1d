"""The skills of the paper by name, and the environments they make."""

from __future__ import annotations

from pathlib import Path

from dcc_jax import runtime
from dcc_jax.character import asset_path, load_character
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.task import Task
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks.registry import (
    TASKS,
    find_task,
    make_task,
    register_task,
    task_name,
)

__all__ = [
    "TASKS",
    "find_task",
    "make_environment",
    "make_task",
    "register_task",
    "task_name",
]


def make_environment(task: Task, config: EnvConfig) -> Environment:
    """The environment of a task.

    Raises:
        ValueError: clips that are missing or do not suit the task.
        MotionError: a clip that cannot be read.
    """
    try:
        clips = _clips(task, config)
    except FileNotFoundError as error:
        raise ValueError(f"{error}") from None
    runtime.ensure()
    references = make_references(clips)
    return Environment(task, load_character(config.mass), references, config)


def _clips(task: Task, config: EnvConfig) -> list[Clip]:
    if config.clips:
        return [load_clip(_clip_path(clip)) for clip in config.clips]
    return [load_clip(_clip_path(clip)) for clip in task.clips]


def _clip_path(clip: str) -> Path:
    """A file `*.npz` where it is, any other name among the package's own clips."""
    path = Path(clip)
    return path if path.suffix == ".npz" else asset_path(f"motions/{clip}.npz")
