"""One episode of a policy's mean action, a control step at a time.

Everything is written for ONE environment. What an episode draws depends on its key and
the number of the control step alone, whoever plays it.
"""

from __future__ import annotations

from typing import Any

import jax

from dcc_jax.env.environment import Environment
from dcc_jax.env.observation import ALPHA_ENTRY
from dcc_jax.env.state import EnvState
from dcc_jax.learn.rollout import Policy
from dcc_jax.play import recording
from dcc_jax.play.recording import Frame

Array = jax.Array


def episode_key(seed: int, episode: Any) -> Array:
    """The key of an episode of a seed."""
    return jax.random.fold_in(jax.random.key(seed), episode)


def begin(environment: Environment, key: Array, alpha: Array) -> EnvState:
    """The state at the start of the episode of a key; alpha acts on the body."""
    return environment.reset(jax.random.fold_in(key, 0), alpha)


def advance(
    environment: Environment,
    policy: Policy,
    state: EnvState,
    key: Array,
    observed_alpha: Array,
    count: Array,
) -> tuple[EnvState, Frame]:
    """One control step.

    Args:
        environment: of the episode.
        policy: acts by its mean.
        state: before the step.
        key: of the episode; not consumed.
        observed_alpha: [] that the policy is told.
        count: [] of this control step, from 1.
    """
    obs = state.obs.at[ALPHA_ENTRY].set(observed_alpha)
    draws = jax.random.fold_in(key, count)
    new, forces = environment.recorded_step(draws, state, policy.mean(obs))
    return new, recording.frame(environment, state, new, forces)
