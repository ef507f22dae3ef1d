"""The compiled program of one character: alpha and pulls are inputs of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.env.environment import Environment
from dcc_jax.env.state import EnvState
from dcc_jax.env.task import Task
from dcc_jax.play import stepping
from dcc_jax.play.pull import Pulled
from dcc_jax.play.recording import Frame
from dcc_jax.play.runs import Run, make_environment

Array = jax.Array


class Program:
    """The compiled reset and control step of one environment, for any policy."""

    def __init__(self, run: Run, task: Mapping[str, Any] | Task | None = None) -> None:
        """Checks the run; nothing is compiled yet.

        Raises:
            ValueError: as `runs.make_environment`.
        """
        if not isinstance(task, Task):
            changes = {f"task.{name}": value for name, value in (task or {}).items()}
            task = run.config.with_(changes).task
        self.environment: Environment = make_environment(run, Pulled(task))
        self._compiled: tuple[Any, Any] | None = None

    @property
    def task(self) -> Task:
        """The task, without hands."""
        pulled = self.environment.task
        assert isinstance(pulled, Pulled)
        return pulled.task

    @property
    def identity(self) -> str:
        """Equal programs have equal ones: alpha and the policy make no difference."""
        env = dataclasses.asdict(self.environment.config)
        return repr((self.task, env | {"alpha": None, "alpha_max": None}))

    @property
    def first_qpos(self) -> np.ndarray:
        """A pose [nq] to show before anything is compiled."""
        scene = self.environment.scene
        qpos = scene.model.qpos0.copy()
        own = slice(scene.qpos_adr, scene.qpos_adr + scene.character.nq)
        qpos[own] = self.environment.nominal
        return qpos

    @property
    def ready(self) -> bool:
        """Whether it is compiled."""
        return self._compiled is not None

    def compile(self, run: Run) -> None:
        """Compiles; the run's policy stands for all of its size."""
        key, alpha = stepping.episode_key(0, 0), jnp.zeros(())
        reset = jax.jit(partial(stepping.begin, self.environment))
        shapes = jax.eval_shape(reset, key, alpha)
        step = jax.jit(partial(stepping.advance, self.environment))
        self._compiled = (
            reset.lower(key, alpha).compile(),
            step.lower(run.policy, shapes, key, alpha, jnp.zeros((), int)).compile(),
        )

    def reset(self, key: Array, alpha: float) -> EnvState:
        """The start of an episode."""
        assert self._compiled is not None
        return self._compiled[0](key, np.float32(alpha))

    def step(
        self, run: Run, state: EnvState, key: Array, told: float, count: int
    ) -> tuple[EnvState, Frame]:
        """A control step of a run's policy; arguments as of `stepping.advance`."""
        assert self._compiled is not None
        return self._compiled[1](
            run.policy, state, key, np.float32(told), np.int32(count)
        )
