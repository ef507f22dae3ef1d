"""A point in the plane that has to run home: an environment that compiles at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.env.rewards import RewardConfig
from dcc_jax.env.task import Task
from dcc_jax.learn.discriminator import DiscriminatorConfig
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.state import TrainConfig

Array = jax.Array


@flax.struct.dataclass
class ToyMetrics:
    distance: Array  # [] m


@flax.struct.dataclass
class ToyState:
    obs: Array  # [3] position and alpha
    features: Array  # [2] position
    previous_features: Array  # [2]
    condition: Array  # [0]
    r_q: Array
    r_p: Array
    r_task: Array
    terminated: Array
    truncated: Array
    nan: Array
    metrics: ToyMetrics
    time: Array  # [] int32 steps since the reset


@dataclass(frozen=True)
class Toy:
    """Moves by its action; ends beyond `wall`, and by the clock after `horizon`.

    alpha shifts home along x, so that runs of different alpha learn different things.
    """

    wall: float = 2.0
    horizon: int = 20
    poisoned: bool = False
    observation_size: int = 3
    action_size: int = 2
    feature_size: int = 2
    condition_size: int = 0
    has_task_reward: bool = False
    tracks_reference: bool = False

    def reset(self, key: Array, alpha: Array | None = None) -> ToyState:
        position = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        level = jnp.zeros(()) if alpha is None else jnp.asarray(alpha)
        return self._state(position, position, level, jnp.zeros((), jnp.int32))

    def step(self, key: Array, state: ToyState, action: Array) -> ToyState:
        noise = 0.01 * jax.random.normal(key, (2,))
        position = state.features + action + noise
        after = self._state(position, state.features, state.obs[2], state.time + 1)
        if not self.poisoned:
            return after
        # Every tenth or so breaks: contained, as the contract of an environment asks.
        nan = position[0] * 1000.0 % 1.0 < 0.1
        return after.replace(nan=nan, terminated=after.terminated | nan)

    def expert_pairs(self, key: Array, spans: Array) -> tuple[Array, Array, Array]:
        s = 0.2 * jax.random.normal(key, (len(spans), 2))
        return s, 0.7 ** spans[:, None] * s, jnp.zeros((len(spans), 0))

    def expert_action(self, state: ToyState) -> Array:
        return -0.5 * state.features

    def style_coordinates(self, s: Array, s_next: Array) -> Array:
        return jnp.concatenate([s, s_next], axis=-1)

    def _state(
        self, position: Array, before: Array, alpha: Array, time: Array
    ) -> ToyState:
        home = jnp.stack([alpha, jnp.zeros(())])
        distance = jnp.linalg.norm(position - home)
        return ToyState(
            obs=jnp.append(position, alpha),
            features=position,
            previous_features=before,
            condition=jnp.zeros(0),
            r_q=jnp.zeros(()),
            r_p=jnp.exp(-2.0 * distance),
            r_task=jnp.zeros(()),
            terminated=jnp.max(jnp.abs(position)) > self.wall,
            truncated=time >= self.horizon,
            nan=jnp.asarray(False),
            metrics=ToyMetrics(distance=distance),
            time=time,
        )


@dataclass(frozen=True)
class ToyTask(Task):
    """What a configuration of the toy names; the environment is given by hand."""

    name: ClassVar[str] = "toy"


@dataclass(frozen=True)
class ToyEnvConfig:
    """What the learner reads of it."""

    reward: RewardConfig = field(default_factory=RewardConfig)


@dataclass(frozen=True)
class ToyConfig:
    """The learner's sections, small."""

    env: ToyEnvConfig = field(default_factory=ToyEnvConfig)
    ppo: PpoConfig = field(
        default_factory=lambda: PpoConfig(
            hidden=(32, 32),
            minibatch_size=128,
            learning_rate=1e-3,
            value_learning_rate=1e-3,
        )
    )
    disc: DiscriminatorConfig = field(
        default_factory=lambda: DiscriminatorConfig(
            hidden=(32, 32), minibatch_size=64, minibatches=4, learning_rate=1e-3
        )
    )
    train: TrainConfig = field(
        default_factory=lambda: TrainConfig(
            num_envs=32, unroll_length=16, warm_start_steps=0, averaged_updates=3
        )
    )
