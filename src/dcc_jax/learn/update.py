"""One update: rollout, discriminator, reward, GAE, PPO, seen from one device.

Parameters are equal on all devices of the mesh axis and gradients are averaged over it,
so two cores (or eight GPUs) each do an equal share of everything.

Letters: T time, B environments of this device, N = T B.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dcc_jax.env import rewards
from dcc_jax.learn import discriminator, networks, normalizer, ppo
from dcc_jax.learn.discriminator import Pairs
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.rollout import (
    Actors,
    Environment,
    Policy,
    Rollout,
    Transition,
    rollout,
)
from dcc_jax.learn.state import (
    AXIS,
    LearnerConfig,
    TrainConfig,
    TrainState,
    UpdateReport,
    of_device,
)

Array = jax.Array

# Environments whose working set stays in the cache of a core (design, section 2.5).
_CPU_CHUNK = 128


def update_state(
    state: TrainState, environment: Environment, config: LearnerConfig
) -> tuple[TrainState, UpdateReport]:
    """Collects T steps of every environment and learns from them.

    The normalisers stay as they are until the end, so that the policy that acted and
    the one that learns see the same numbers.
    """
    key, rollout_key, disc_key, ppo_key = jax.random.split(state.key, 4)
    actors = Actors(
        policy=Policy(
            params=state.agent.policy.params, normalizer=state.obs_normalizer
        ),
        value=state.agent.value.params,
        alpha=state.alpha,
    )
    taken = rollout(
        of_device(rollout_key),
        environment,
        actors,
        state.running,
        config.train.unroll_length,
        config.ppo,
        chunk_size(config.train, state.running.steps.shape[0]),
    )
    disc, disc_metrics, expert = _train_discriminator(
        of_device(disc_key), state, taken.transitions.pairs, environment, config
    )
    reward, reward_metrics = _rewards(
        disc.params, state, taken.transitions, environment, config
    )
    batch = _ppo_batch(state, taken, reward, config.ppo)
    agent, ppo_metrics = ppo.update(
        of_device(ppo_key), state.agent, batch, config.ppo, AXIS
    )
    state, episode_metrics = _counted(state, taken.transitions)
    state = dataclasses.replace(
        state,
        agent=agent,
        disc=disc,
        obs_normalizer=normalizer.update(
            state.obs_normalizer, _flat(taken.transitions.obs), AXIS
        ),
        feature_normalizer=_features_seen(state, taken.transitions.pairs, expert),
        running=taken.running,
        key=key,
    )
    means = jax.lax.pmean(reward_metrics | _env_metrics(taken.env_metrics), AXIS)
    metrics = means | disc_metrics | ppo_metrics | episode_metrics
    incident = jax.tree.map(lambda x: x[None], taken.incident)
    return state, UpdateReport(metrics=metrics, incident=incident)


def _train_discriminator(
    key: Array,
    state: TrainState,
    pairs: Pairs,
    environment: Environment,
    config: LearnerConfig,
) -> tuple[networks.Network, dict[str, Array], Array]:
    """The discriminator after its minibatches, and the clip features it saw [N, F]."""
    size = config.disc.minibatch_size // jax.lax.axis_size(AXIS)
    count = config.disc.minibatches * size
    expert_key, row_key = jax.random.split(key)
    expert = Pairs(*environment.expert_pairs(expert_key, count))
    flat = jax.tree.map(_flat, pairs)
    rows = jax.random.randint(row_key, (count,), 0, flat.s.shape[0])
    policy = jax.tree.map(lambda x: x[rows], flat)

    def minibatches(pairs: Pairs) -> Array:
        x = discriminator.inputs(state.feature_normalizer, pairs)
        return x.reshape(config.disc.minibatches, size, -1)

    disc, metrics = discriminator.update(
        state.disc, minibatches(expert), minibatches(policy), config.disc, AXIS
    )
    return disc, metrics, expert.s_next


def _rewards(
    params: networks.Mlp,
    state: TrainState,
    transitions: Transition,
    environment: Environment,
    config: LearnerConfig,
) -> tuple[Array, dict[str, Array]]:
    """Eq. 10, 11 and 13: the reward [T, B], and the means of its parts."""
    weights = config.env.reward
    if environment.tracks:
        r_q = transitions.r_q
    else:
        x = discriminator.inputs(state.feature_normalizer, transitions.pairs)
        r_q = rewards.pose_reward(discriminator.score(params, x), weights)
    r_task = transitions.r_task if environment.has_task_reward else None
    total = rewards.reward(r_q, transitions.r_p, weights, r_task)
    return total, {
        "reward/total": jnp.mean(total),
        "reward/r_q": jnp.mean(r_q),
        "reward/r_p": jnp.mean(transitions.r_p),
        "reward/r_task": jnp.mean(transitions.r_task),
    }


def _ppo_batch(
    state: TrainState, taken: Rollout, reward: Array, config: PpoConfig
) -> ppo.Batch:
    transitions = taken.transitions
    value = state.agent.value.params
    obs = normalizer.normalize(state.obs_normalizer, transitions.obs)
    last = normalizer.normalize(state.obs_normalizer, taken.running.env.obs)
    values = ppo.value_of(value, obs, config.discount)
    last_value = ppo.value_of(value, last, config.discount)
    following = jnp.concatenate([values[1:], last_value[None]])
    advantage = ppo.gae(
        reward,
        values,
        jnp.where(transitions.truncated, transitions.final_value, following),
        transitions.terminated,
        transitions.truncated,
        config.discount,
        config.gae_lambda,
    )
    mean = jax.lax.pmean(jnp.mean(advantage), AXIS)
    variance = jax.lax.pmean(jnp.mean((advantage - mean) ** 2), AXIS)
    return ppo.Batch(
        obs=_flat(obs),
        action=_flat(transitions.action),
        log_prob=_flat(transitions.log_prob),
        advantage=_flat((advantage - mean) / (jnp.sqrt(variance) + 1e-6)),
        target=_flat(advantage + values),
    )


def _counted(
    state: TrainState, transitions: Transition
) -> tuple[TrainState, dict[str, Array]]:
    """The counters after this update; with no episode ended, the last figures stay."""
    lengths = transitions.length.astype(jnp.float32)
    ended, steps, fallen, broken = jax.lax.psum(
        (
            jnp.sum(transitions.length > 0),
            jnp.sum(lengths),
            jnp.sum(transitions.terminated),
            jnp.sum(transitions.nan),
        ),
        AXIS,
    )
    some = jnp.maximum(ended, 1)
    state = dataclasses.replace(
        state,
        update=state.update + 1,
        nan_count=state.nan_count + broken,
        episode_length=jnp.where(ended > 0, steps / some, state.episode_length),
        fall_rate=jnp.where(ended > 0, fallen / some, state.fall_rate),
    )
    return state, {
        "episode/length": state.episode_length,
        "episode/fall_rate": state.fall_rate,
        "episode/ended": ended,
        "nan_count": state.nan_count,
    }


def _features_seen(
    state: TrainState, pairs: Pairs, expert: Array
) -> normalizer.Normalizer:
    """Policy and clip features in equal shares, as the discriminator sees them."""
    policy = _flat(pairs.s_next)[: expert.shape[0]]
    both = jnp.concatenate([policy, expert[: policy.shape[0]]])
    return normalizer.update(state.feature_normalizer, both, AXIS)


def _env_metrics(metrics: Any) -> dict[str, Array]:
    leaves = jax.tree_util.tree_leaves_with_path(metrics)
    return {
        "env/" + jax.tree_util.keystr(path, simple=True, separator="/"): value
        for path, value in leaves
    }


def _flat(x: Array) -> Array:
    """[T, B, ...] -> [N, ...]."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])


def chunk_size(config: TrainConfig, local_envs: int) -> int | None:
    """Environments that a device steps at once, or None for all of them."""
    if config.chunk_size is not None:
        return min(config.chunk_size, local_envs)
    on_cpu = jax.default_backend() == "cpu"
    return min(_CPU_CHUNK, local_envs) if on_cpu else None
