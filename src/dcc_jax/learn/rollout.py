"""Environments over time and over the batch; the only auto-reset of the project.

Letters: T time, B environments, O observation, A actions, F body features, C condition,
K span of the discriminator's pairs.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.learn import networks, normalizer, ppo
from dcc_jax.learn.contract import Environment
from dcc_jax.learn.discriminator import Pairs

Array = jax.Array
_SHARE_OF_RESETS = 16  # of the environments, one in so many is reset at once


@flax.struct.dataclass
class Policy:
    """All that is needed to act."""

    params: networks.Mlp
    normalizer: normalizer.Normalizer

    def mean(self, obs: Array) -> Array:
        """Mean action [..., A] in rad for raw observations [..., O]."""
        return networks.apply_mlp(
            self.params, normalizer.normalize(self.normalizer, obs)
        )


@flax.struct.dataclass
class Actors:
    """What acts in a rollout, frozen while it lasts."""

    policy: Policy
    value: networks.Mlp
    alpha: Array | None  # [] compliance level, or None: the environment's own


@flax.struct.dataclass
class Running:
    """The environments between two rollouts."""

    env: Any  # EnvState, every leaf [B, ...]
    steps: Array  # [B] int32 control steps since the reset
    earlier: Array  # [B, K - 1, F] features before now, oldest first

    @classmethod
    def of(cls, env: Any, span: int) -> Running:
        """Episodes that begin with the resets `env`, every leaf [B, ...], and K."""
        return cls(
            env=env,
            steps=jnp.zeros(env.features.shape[0], jnp.int32),
            earlier=jnp.repeat(env.features[:, None], span - 1, axis=1),
        )

    @property
    def span(self) -> int:
        """K."""
        return self.earlier.shape[1] + 1

    @property
    def remembered(self) -> Array:
        """Features [B, K, F] of the last K control steps, or the reset's."""
        return jnp.concatenate([self.earlier, self.env.features[:, None]], axis=1)


@flax.struct.dataclass
class Transition:
    """One control step of every environment."""

    obs: Array  # [T, B, O] raw, before the step
    action: Array  # [T, B, A] rad
    log_prob: Array  # [T, B]
    pairs: Pairs  # [T, B, ...] body features before and after
    span: Array  # [T, B] int32 control steps between the two
    r_q: Array  # [T, B] read where the environment tracks
    r_p: Array  # [T, B]
    r_task: Array  # [T, B]
    terminated: Array  # [T, B] bool
    truncated: Array  # [T, B] bool
    nan: Array  # [T, B] bool
    final_value: Array  # [T, B] V of the last state of a truncated episode, else 0
    length: Array  # [T, B] int32 steps of the episode that ends here, else 0


@flax.struct.dataclass
class Incident:
    """The last environment that broke: its state and action just before."""

    happened: Array  # [] bool
    env: Any  # EnvState of ONE environment
    action: Array  # [A] rad


@flax.struct.dataclass
class Rollout:
    """What a rollout leaves."""

    running: Running
    transitions: Transition  # [T, B, ...]
    env_metrics: Any  # the environment's metrics, averaged over T and B, []
    incident: Incident


def reset_all(
    keys: Array, environment: Environment, alpha: Array | None, span: int = 1
) -> Running:
    """Fresh episodes in as many environments as there are keys, [B].

    Args:
        keys: consumed.
        environment: the functions of one environment.
        alpha: level of compliance [], or None: the environment's own.
        span: K.
    """
    env = jax.vmap(lambda key: environment.reset(key, alpha))(keys)
    return Running.of(env, span)


def rollout(
    key: Array,
    environment: Environment,
    actors: Actors,
    running: Running,
    length: int,
    config: ppo.PpoConfig,
    chunk: int | None = None,
) -> Rollout:
    """Acts for `length` control steps in every environment.

    Args:
        key: consumed.
        environment: the functions of one environment.
        actors: policy, value function, level of compliance.
        running: B environments.
        length: T.
        config: sigma and discount.
        chunk: environments stepped at once, a divisor of B; the rest waits, so that
            the working set stays in a CPU's cache. None: all.
    """
    count = running.steps.shape[0]
    draws = _draws(key, length, running, environment)
    if chunk is None or chunk >= count:
        return _rollout(draws, environment, actors, running, config)
    chunks = count // chunk
    split = jax.tree.map(lambda x: x.reshape(chunks, chunk, *x.shape[1:]), running)
    # Drawn before the split: the size of a chunk changes no draw.
    shares = jax.tree.map(lambda x: _divided(x, chunks), draws)
    parts: Rollout = jax.lax.map(
        lambda part: _rollout(part[0], environment, actors, part[1], config),
        (shares, split),
    )
    return _joined(parts, count)


def _rollout(
    draws: tuple[Array, Array, Array],
    environment: Environment,
    actors: Actors,
    running: Running,
    config: ppo.PpoConfig,
) -> Rollout:
    def step(
        carry: tuple[Running, Incident], draws: tuple[Array, Array, Array]
    ) -> tuple[tuple[Running, Incident], tuple[Transition, Any]]:
        running, incident = carry
        noise, step_keys, reset_keys = draws
        mean = actors.policy.mean(running.env.obs)
        action = mean + config.sigma * noise
        log_prob = ppo.log_prob(mean, action, config.sigma)
        env = jax.vmap(environment.step)(step_keys, running.env, action)
        incident = _recorded(incident, env.nan, running.env, action)
        transition = _transition(running, env, action, log_prob, actors, config)
        means = jax.tree.map(jnp.mean, env.metrics)
        running = _auto_reset(reset_keys, environment, actors, running, env)
        return (running, incident), (transition, means)

    one = jax.tree.map(lambda x: x[0], running.env)
    nothing = Incident(
        happened=jnp.asarray(False),
        env=one,
        action=jnp.zeros(environment.action_size),
    )
    (running, incident), (transitions, means) = jax.lax.scan(
        step, (running, nothing), draws
    )
    return Rollout(
        running=running,
        transitions=transitions,
        env_metrics=jax.tree.map(jnp.mean, means),
        incident=incident,
    )


def _draws(
    key: Array, length: int, running: Running, environment: Environment
) -> tuple[Array, Array, Array]:
    """Action noise [T, B, A], step keys and reset keys [T, B], all drawn at once."""
    count = running.steps.shape[0]
    noise_key, step_key, reset_key = jax.random.split(key, 3)
    noise = jax.random.normal(noise_key, (length, count, environment.action_size))
    step_keys = jax.random.split(step_key, (length, count))
    return noise, step_keys, jax.random.split(reset_key, (length, count))


def _transition(
    before: Running,
    env: Any,
    action: Array,
    log_prob: Array,
    actors: Actors,
    config: ppo.PpoConfig,
) -> Transition:
    ends = env.terminated | env.truncated
    return Transition(
        obs=before.env.obs,
        action=action,
        log_prob=log_prob,
        pairs=Pairs(
            s=before.remembered[:, 0], s_next=env.features, condition=env.condition
        ),
        span=jnp.minimum(before.steps + 1, before.span),
        r_q=env.r_q,
        r_p=env.r_p,
        r_task=env.r_task,
        terminated=env.terminated,
        truncated=env.truncated,
        nan=env.nan,
        final_value=_final_value(actors, env, config.discount),
        length=jnp.where(ends, before.steps + 1, 0),
    )


def _final_value(actors: Actors, env: Any, discount: float) -> Array:
    # Few episodes run out of time in any one step: most steps need no network at all.
    def value(obs: Array) -> Array:
        normalized = normalizer.normalize(actors.policy.normalizer, obs)
        return ppo.value_of(actors.value, normalized, discount)

    values: Array = jax.lax.cond(
        jnp.any(env.truncated), value, lambda obs: jnp.zeros(obs.shape[0]), env.obs
    )
    return jnp.where(env.truncated, values, 0.0)


def _auto_reset(
    keys: Array, environment: Environment, actors: Actors, before: Running, env: Any
) -> Running:
    """Where episodes end others begin, a few at a time: few end in any one step."""
    count = before.steps.shape[0]
    few = -(-count // _SHARE_OF_RESETS)
    # The checker of keys takes a loop for a second use.
    data, impl = jax.random.key_data(keys), jax.random.key_impl(keys)

    def renewed(state: tuple[Running, Array]) -> tuple[Running, Array]:
        running, left = state
        (chosen,) = jnp.nonzero(left, size=few, fill_value=0)
        of_chosen = jax.random.wrap_key_data(data[chosen], impl=impl)
        fresh = reset_all(of_chosen, environment, actors.alpha, before.span)
        place = jnp.cumsum(left) - 1  # of an environment among the chosen
        now, at = left & (place < few), jnp.clip(place, 0, few - 1)
        running = jax.tree.map(
            lambda new, old: _where(now, new[at], old), fresh, running
        )
        return running, left & ~now

    going_on = Running(
        env=env, steps=before.steps + 1, earlier=before.remembered[:, 1:]
    )
    ends = env.terminated | env.truncated
    state = going_on, ends
    return jax.lax.while_loop(lambda state: jnp.any(state[1]), renewed, state)[0]


def _recorded(incident: Incident, nan: Array, env: Any, action: Array) -> Incident:
    def record(_: Incident) -> Incident:
        at = jnp.argmax(nan)
        state = jax.tree.map(lambda x: x[at], env)
        return Incident(happened=jnp.asarray(True), env=state, action=action[at])

    return jax.lax.cond(jnp.any(nan), record, lambda old: old, incident)


def _divided(x: Array, chunks: int) -> Array:
    """[T, B, ...] -> [chunks, T, b, ...], of numbers or keys."""
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        # The checker of keys takes a transposition for a use.
        data = _divided(jax.random.key_data(x), chunks)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))
    return jnp.moveaxis(x.reshape(x.shape[0], chunks, -1, *x.shape[2:]), 1, 0)


def _joined(parts: Rollout, count: int) -> Rollout:
    """Undoes the chunks, leading axis first: [chunks, T, b, ...] -> [T, B, ...]."""

    def over_time(x: Array) -> Array:
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], count, *x.shape[3:])

    broken = jnp.argmax(parts.incident.happened)
    return Rollout(
        running=jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), parts.running),
        transitions=jax.tree.map(over_time, parts.transitions),
        env_metrics=jax.tree.map(lambda x: jnp.mean(x, axis=0), parts.env_metrics),
        incident=jax.tree.map(lambda x: x[broken], parts.incident),
    )


def _where(ends: Array, new: Array, old: Array) -> Array:
    return jnp.where(ends.reshape(-1, *([1] * (new.ndim - 1))), new, old)
