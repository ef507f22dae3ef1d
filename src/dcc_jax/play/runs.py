"""Trained policies: where they are found, and the environments they act in."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dcc_jax import config, tasks
from dcc_jax.character import asset_path
from dcc_jax.config import Config
from dcc_jax.env.environment import Environment, follows_reference
from dcc_jax.env.task import Task
from dcc_jax.learn.rollout import Policy
from dcc_jax.training import checkpoint, folder

_FOREVER = 1e6  # s


@dataclass(frozen=True)
class Run:
    """A trained policy and the configuration that made it."""

    name: str
    config: Config
    policy: Policy

    @property
    def alphas(self) -> tuple[float, float]:
        """The least and the greatest level of compliance it was trained with."""
        env = self.config.env
        return env.alpha, env.alpha if env.alpha_max is None else env.alpha_max


def find_run(name: str | Path) -> Run:
    """The policy in a run directory, or one of those that ship, by path or name.

    Raises:
        ValueError: there is none, or it is damaged, or there are the many of a sweep.
    """
    path = folder.find(name)
    return Run(str(name), config.load(path), checkpoint.load_policy(path))


def known_runs() -> list[str]:
    """Names of all policies at hand: those that ship, then those in `runs/`."""
    shipped: list[str] = []
    with contextlib.suppress(FileNotFoundError):
        shipped = [p.parent.name for p in asset_path("policies").glob("*/policy.npz")]
    order = list(tasks.TASKS)
    shipped.sort(key=lambda name: (order.index(name) if name in order else 99, name))
    own = sorted(str(p.parent) for p in Path("runs").glob("**/policy.npz"))
    return shipped + own


def make_environment(
    run: Run, task: Mapping[str, Any] | Task | None = None
) -> Environment:
    """The environment of a run, without an end: episodes are as long as one likes.

    A clip that the task follows in time is played from its start, not from anywhere.

    Args:
        run: whose configuration counts.
        task: other parameters of the run's task, `{"width": 1.5}`, or a task in its
            place; None: as it was trained.

    Raises:
        ValueError: unknown parameters, clips that are missing or damaged, or another
            observation or action than the policy's.
    """
    if not isinstance(task, Task):
        changes = {f"task.{name}": value for name, value in (task or {}).items()}
        task = run.config.with_(changes).task
    env = dataclasses.replace(
        run.config.env,
        episode_seconds=_FOREVER,
        random_start=run.config.env.random_start
        and not follows_reference(task, run.config.env),
    )
    environment = tasks.make_environment(task, env)
    sizes = environment.observation_size, environment.action_size
    layers = run.policy.params.layers
    has = layers[0].kernel.shape[0], layers[-1].kernel.shape[1]
    if has != sizes:
        raise ValueError(
            f"the policy of {run.name} has {has[0]} observations and {has[1]} actions, "
            f"task {environment.task.name} has {sizes[0]} and {sizes[1]}"
        )
    return environment
