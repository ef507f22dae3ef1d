"""What the experiments of commanded speeds share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.env.task import Task
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.physics import Scene
from dcc_jax.play.player import Player
from dcc_jax.play.recording import Recording
from dcc_jax.play.runs import Run, find_run, make_environment

T = TypeVar("T", bound=Task)


def steady(key: jax.Array, motion: Motion, speeds: tuple[float, ...]) -> Motion:
    """The motion if it wants one of the speeds, m/s, for ever; the key is consumed."""
    speed = jax.random.choice(key, jnp.array(speeds))
    return replace(motion, wanted_speed=speed, left=jnp.asarray(1e6))


def straight(gaits: Gaits) -> Gaits:
    """The same without turns."""
    return replace(gaits, turn_rate=0.0)


def asked(
    doc: str, kind: type[T], episodes: int = 256
) -> tuple[argparse.Namespace, Run, T]:
    """The command line's options, the policy that it names, and its task.

    Args:
        doc: what the experiment says of itself.
        kind: the task that the policy must be of.
        episodes: where nothing else is said.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_DIR|NAME")
    add("--episodes", type=int, default=episodes)
    add("--seconds", type=float, default=10.0)
    add("--alpha", type=float, default=0.0)
    add("--seed", type=int, default=0)
    options = parser.parse_args()
    run = find_run(options.run)
    task = run.config.task
    if not isinstance(task, kind):
        parser.error(f"{options.run} is a policy of {task.name}")
    return options, run, task


def played(
    doc: str, kind: type[T], made: Callable[[T], Task]
) -> tuple[Recording, Scene]:
    """Reads the command line and plays.

    Args:
        doc: as of `asked`.
        kind: likewise.
        made: the task to play, of that of the policy, which has gaits.
    """
    options, run, task = asked(doc, kind)
    player = Player(make_environment(run, made(task)))
    recording = player.play(
        run,
        np.arange(options.episodes),
        np.full(options.episodes, options.alpha),
        seed=options.seed,
        seconds=options.seconds,
        motion=True,
    )
    return recording, player.environment.scene
