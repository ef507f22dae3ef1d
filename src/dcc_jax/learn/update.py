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
import optax

from dcc_jax.env import rewards
from dcc_jax.learn import discriminator, networks, normalizer, ppo
from dcc_jax.learn.discriminator import Pairs
from dcc_jax.learn.exchange import all_gather_tree
from dcc_jax.learn.normalizer import Normalizer
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
# Environments whose working set stays in the cache of a core.
_CPU_CHUNK = 128


def update_state(
    state: TrainState, environment: Environment, config: LearnerConfig
) -> tuple[TrainState, UpdateReport]:
    """Collects T steps of every environment and learns from them.

    The normalisers stay as they are until the end, so that the policy that acted and
    the one that learns see the same numbers.
    """
    key, of_this_update = jax.random.split(state.key)
    rollout_key, disc_key, ppo_key = jax.random.split(of_device(of_this_update), 3)
    actors = Actors(
        policy=Policy(
            params=state.agent.policy.params, normalizer=state.obs_normalizer
        ),
        value=state.agent.value.params,
        alpha=state.alpha,
    )
    taken = rollout(
        rollout_key,
        environment,
        actors,
        state.running,
        config.train.unroll_length,
        config.ppo,
        chunk_size(config.train, state.running.steps.shape[0]),
    )
    metrics = _env_metrics(taken.env_metrics)
    seen = {"obs": normalizer.moments(_flat(taken.transitions.obs))}
    if not environment.tracks_reference:
        disc, of_disc, features = _train_discriminator(
            disc_key, state, taken.transitions, environment, config
        )
        metrics |= of_disc
        seen |= {"features": features}
        state = dataclasses.replace(state, disc=disc)
    reward, of_reward = _rewards(state, taken.transitions, environment, config)
    batch = _ppo_batch(state, taken, reward, config.ppo)
    agent, of_ppo = ppo.update(ppo_key, state.agent, batch, config.ppo, AXIS)
    waits = config.train.waits
    if waits:
        agent = _policy_waiting(state, agent, waits)
    averaged = _averaged(state, agent, config.train)
    metrics |= of_reward | of_ppo
    episodes = _episodes(taken.transitions)
    metrics, seen, episodes = all_gather_tree((metrics, seen, episodes), AXIS)
    metrics = jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)
    state, of_episodes = _counted(state, episodes)
    state = dataclasses.replace(
        _seen(state, seen),
        agent=agent,
        averaged=averaged,
        running=taken.running,
        key=key,
    )
    incident = jax.tree.map(lambda x: x[None], taken.incident)
    return state, UpdateReport(metrics=metrics | of_episodes, incident=incident)


def _averaged(state: TrainState, agent: ppo.Agent, config: TrainConfig) -> networks.Mlp:
    """The mean of the policies of all updates, later one that forgets the older ones.

    Departure: the paper takes the last policy, as `train.averaged_updates = 1` does.
    """
    count = jnp.clip(state.update + 1 - config.waits, 1, config.averaged_updates)
    now: Any = agent.policy.params  # Any: optax's types know no dataclass
    before: Any = state.averaged
    mean: Any = optax.incremental_update(now, before, 1.0 / count)
    return mean


def _policy_waiting(state: TrainState, agent: ppo.Agent, updates: int) -> ppo.Agent:
    """The new agent, whose policy stays what it was in the first updates.

    The advantages of a value function that knows nothing yet would spoil it.
    """
    waits = state.update < updates
    policy = jax.tree.map(
        lambda old, new: jnp.where(waits, old, new), state.agent.policy, agent.policy
    )
    return dataclasses.replace(agent, policy=policy)


def _train_discriminator(
    key: Array,
    state: TrainState,
    transitions: Transition,
    environment: Environment,
    config: LearnerConfig,
) -> tuple[networks.Network, dict[str, Array], Normalizer]:
    """The discriminator after its minibatches, metrics, and moments of the features.

    Policy and clip count in equal shares in them, as the discriminator sees them.
    """
    size = config.disc.minibatch_size // jax.lax.axis_size(AXIS)
    count = config.disc.minibatches * size
    expert_key, row_key, noise_key = jax.random.split(key, 3)
    flat = jax.tree.map(_flat, transitions.pairs)
    share, tuples = jax.random.uniform(row_key, (count,)), flat.s.shape[0]
    rows = (share * tuples).astype(jnp.int32)
    policy = jax.tree.map(lambda x: x[rows], flat)
    spans = _flat(transitions.span)[rows]
    expert = Pairs(*environment.expert_pairs(expert_key, spans))

    normal = state.feature_normalizer
    x_expert = discriminator.inputs(normal, expert, config.disc)
    x_policy = discriminator.inputs(normal, policy, config.disc)
    # The same noise on both sets: random numbers are a twentieth of an update.
    blurred = jax.vmap(
        lambda x: discriminator.blurred(noise_key, x, flat.s.shape[-1], config.disc)
    )(jnp.stack([x_expert, x_policy]))
    of_expert, of_policy = blurred.reshape(2, config.disc.minibatches, size, -1)
    disc, metrics = discriminator.update(
        state.disc, of_expert, of_policy, config.disc, AXIS
    )
    metrics |= discriminator.judged(disc.params, x_expert, x_policy)
    both = jnp.concatenate([policy.s_next, expert.s_next])
    return disc, metrics, normalizer.moments(both)


def _rewards(
    state: TrainState,
    transitions: Transition,
    environment: Environment,
    config: LearnerConfig,
) -> tuple[Array, dict[str, Array]]:
    """Eq. (10), (11) and (13): the reward [T, B], and the means of its parts."""
    weights = config.env.reward
    if environment.tracks_reference:
        r_q = transitions.r_q
    else:
        x = discriminator.inputs(
            state.feature_normalizer, transitions.pairs, config.disc
        )
        r_q = rewards.pose_reward(discriminator.score(state.disc.params, x), weights)
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
    local = normalizer.moments(advantage.reshape(-1))
    spread = normalizer.pooled(all_gather_tree(local, AXIS))
    return ppo.Batch(
        obs=_flat(obs),
        action=_flat(transitions.action),
        log_prob=_flat(transitions.log_prob),
        advantage=_flat((advantage - spread.mean) / (jnp.sqrt(spread.variance) + 1e-6)),
        target=_flat(advantage + values),
    )


def _episodes(transitions: Transition) -> dict[str, Array]:
    """Counts of this device's episodes."""
    return {
        "ended": jnp.sum(transitions.length > 0),
        "steps": jnp.sum(transitions.length),
        "fallen": jnp.sum(transitions.terminated),
        "broken": jnp.sum(transitions.nan),
    }


def _counted(
    state: TrainState, episodes: dict[str, Array]
) -> tuple[TrainState, dict[str, Array]]:
    """The counters after this update; with no episode ended, the last figures stay."""
    total = {name: jnp.sum(of_devices) for name, of_devices in episodes.items()}
    ended, some = total["ended"], jnp.maximum(total["ended"], 1)
    length, fall_rate = total["steps"] / some, total["fallen"] / some
    state = dataclasses.replace(
        state,
        update=state.update + 1,
        nan_count=state.nan_count + total["broken"],
        episode_length=jnp.where(ended > 0, length, state.episode_length),
        fall_rate=jnp.where(ended > 0, fall_rate, state.fall_rate),
    )
    return state, {
        "episode/length": state.episode_length,
        "episode/fall_rate": state.fall_rate,
        "episode/ended": ended,
        "nan_count": state.nan_count,
    }


def _seen(state: TrainState, of_devices: dict[str, Normalizer]) -> TrainState:
    """The normalisers with what the devices saw in this update."""
    seen = {name: normalizer.pooled(parts) for name, parts in of_devices.items()}
    obs = normalizer.merge(state.obs_normalizer, seen["obs"])
    state = dataclasses.replace(state, obs_normalizer=obs)
    if "features" in seen:
        features = normalizer.merge(state.feature_normalizer, seen["features"])
        state = dataclasses.replace(state, feature_normalizer=features)
    return state


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
    if jax.default_backend() != "cpu":
        return None
    even = [n for n in range(_CPU_CHUNK // 4, _CPU_CHUNK + 1) if local_envs % n == 0]
    return max(even, default=local_envs)
