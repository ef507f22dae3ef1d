"""The skills of the paper by name, and the environments they make."""

from __future__ import annotations

import sys
from pathlib import Path

from dcc_jax import runtime
from dcc_jax.character import asset_path, load_character
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.task import Task
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.reference import make_references
from dcc_jax.motion.retarget.importer import Options, import_motion
from dcc_jax.motion.retarget.verdict import verdict
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

MOTION_ENDINGS = (".bvh", ".amc", ".txt", ".json")  # of files that are imported


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
    return [_clip(clip) for clip in config.clips or task.clips]


def _clip(name: str) -> Clip:
    """A clip `*.npz`, a motion file that is imported, or one of the package's clips.

    Raises:
        MotionError: a file that cannot be read, or is no motion.
        FileNotFoundError: the package has no such clip.
    """
    path = Path(name)
    if path.suffix == ".npz":
        return load_clip(path)
    if path.suffix.lower() in MOTION_ENDINGS:
        imported = import_motion(path, Options())
        print(f"{name}: imported; {verdict(imported.doubts)}", file=sys.stderr)
        return imported.clip
    if path.is_dir():
        raise MotionError(path, "is a directory; a clip is a file")
    if path.is_file():
        known = ", ".join((".npz", *MOTION_ENDINGS))
        raise MotionError(path, f"not a motion: its name ends in none of {known}")
    return load_clip(asset_path(f"motions/{name}.npz"))
