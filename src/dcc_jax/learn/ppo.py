"""Proximal policy optimisation with a Gaussian of fixed width (Sec. 4, 5.1).

Letters: T time, B environments, N samples, O observation, A actions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.learn import networks
from dcc_jax.learn.exchange import mean_tree

Array = jax.Array


@dataclass(frozen=True)
class PpoConfig:
    """The policy, the value function and how they learn."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the hidden layers of both networks (Sec. 5.1)."""

    activation: networks.Activation = "relu"
    """Between the layers of both networks; the paper does not say. ReLUs may die, but
    ELUs learned `hand-in-hand` more slowly (docs/skills/hand-in-hand.md)."""

    sigma_degrees: float = 6.0
    """Standard deviation of every action (Sec. 5.1)."""

    discount: float = 0.95
    """gamma of Eq. (9) (Sec. 5.1)."""

    gae_lambda: float = 0.95
    """lambda of the generalized advantage estimate (Sec. 5.1)."""

    clip: float = 0.2
    """The probability ratio counts within 1 +- clip (Schulman 2017)."""

    learning_rate: float = 1e-5
    """Step size of the policy (Sec. 5.1), the first one if `target_kl` is set: within
    an update or two it is where the divergence takes it."""

    value_learning_rate: float = 3e-4
    """Step size of the value function; the paper has 1e-5 for both."""

    target_kl: float | None = 0.02
    """The step size follows this KL divergence between the old and the new policy
    (Rudin 2021), which frees the choice of `learning_rate`; the paper's is fixed."""

    minibatch_size: int = 2048
    """Tuples in a step; the paper has 128 (Sec. 5.1)."""

    epochs: int = 4
    """Passes over the tuples of an update; the paper does not say."""

    max_gradient_norm: float = 1.0
    """Longer gradients are scaled down to this norm (usual; not the paper's)."""

    def __post_init__(self) -> None:
        positive = ("sigma_degrees", "clip", "max_gradient_norm")
        for name in (*positive, "learning_rate", "value_learning_rate"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        for name in ("discount", "gae_lambda"):
            value = getattr(self, name)
            _require(0 <= value <= 1, name, value, "between 0 and 1")
        for name in ("minibatch_size", "epochs"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")
        kl = self.target_kl
        _require(kl is None or kl > 0, "target_kl", kl, "positive or None")
        widths = all(width > 0 for width in self.hidden)
        _require(widths, "hidden", self.hidden, "positive widths")
        known = self.activation in networks.ACTIVATIONS
        allowed = f"one of {', '.join(networks.ACTIVATIONS)}"
        _require(known, "activation", self.activation, allowed)

    @property
    def sigma(self) -> float:
        """Standard deviation of every action, rad."""
        return math.radians(self.sigma_degrees)


@flax.struct.dataclass
class Batch:
    """What a gradient step sees of N tuples."""

    obs: Array  # [N, O] normalised observation
    action: Array  # [N, A] rad
    log_prob: Array  # [N] of the action under the policy that took it
    advantage: Array  # [N] normalised over the update
    target: Array  # [N] return that the value function learns


@flax.struct.dataclass
class Agent:
    """The two networks that PPO trains."""

    policy: networks.Network
    value: networks.Network


# The adaptive step size stays within these; Rudin (2021) goes up to 1e-2. Where the
# policy hardly answers at first, as in a stand, it would grow until the first answer
# kills the ReLUs: at 1e-3 a whole layer died and `ball` learned nothing more.
_MIN_LEARNING_RATE = 1e-6
_MAX_LEARNING_RATE = 3e-4


def init_agent(
    key: Array, observation_size: int, action_size: int, config: PpoConfig
) -> Agent:
    """Draws both networks.

    Departure: the last layers are a hundredth of Xavier's, so that the first policy
    leaves the pose offsets near zero and the first values are, instead of random ones.
    """
    policy_key, value_key = jax.random.split(key)
    policy = networks.init_mlp(
        policy_key,
        (observation_size, *config.hidden, action_size),
        output_gain=0.01,
        activation=config.activation,
    )
    sizes = (observation_size, *config.hidden, 1)
    value = networks.init_mlp(
        value_key, sizes, output_gain=0.01, activation=config.activation
    )
    of_policy, of_value = make_optimizers(config)
    return Agent(
        policy=networks.init_network(policy, of_policy),
        value=networks.init_network(value, of_value),
    )


def make_optimizers(c: PpoConfig) -> tuple[networks.Optimizer, networks.Optimizer]:
    """The policy's, whose step size may change, and the value function's."""
    policy = networks.adjustable_adam(c.learning_rate, c.max_gradient_norm)
    return policy, networks.clipped_adam(c.value_learning_rate, c.max_gradient_norm)


def log_prob(mean: Array, action: Array, sigma: float) -> Array:
    """Log density [...] of actions [..., A] under N(mean, sigma^2)."""
    z = (action - mean) / sigma
    size = action.shape[-1]
    constant = size * (math.log(sigma) + 0.5 * math.log(2.0 * math.pi))
    return -0.5 * jnp.sum(z * z, axis=-1) - constant


def value_of(params: networks.Mlp, obs: Array, discount: float) -> Array:
    """V(obs) [...] for normalised observations [..., O].

    The network gives V in units of 1 / (1 - gamma), the return of a reward of one for
    ever: its targets are then of order one whatever the discount.
    """
    return networks.apply_mlp(params, obs)[..., 0] * _value_scale(discount)


def gae(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    discount: float,
    gae_lambda: float,
) -> Array:
    """Generalized advantage estimate [T, B] (Schulman 2016).

    Args:
        rewards: r_t, [T, B].
        values: V of the state each step left, [T, B].
        next_values: V of the state it reached, before any reset, [T, B].
        terminated: [T, B] bool; nothing comes after, so V of the reached state is void.
        truncated: [T, B] bool; only the episode's clock ran out, so it counts.
        discount: gamma.
        gae_lambda: lambda.
    """
    goes_on = 1.0 - terminated.astype(rewards.dtype)
    same_episode = goes_on * (1.0 - truncated.astype(rewards.dtype))
    delta = rewards + discount * goes_on * next_values - values

    def step(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, same_episode = now
        advantage = delta + discount * gae_lambda * same_episode * later
        return advantage, advantage

    _, advantages = jax.lax.scan(
        step, jnp.zeros_like(rewards[0]), (delta, same_episode), reverse=True
    )
    return advantages


def policy_loss(
    params: networks.Mlp, batch: Batch, config: PpoConfig
) -> tuple[Array, dict[str, Array]]:
    """Clipped surrogate [] of Schulman 2017, and scalar metrics."""
    mean = networks.apply_mlp(params, batch.obs)
    log_ratio = log_prob(mean, batch.action, config.sigma) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    outside = jnp.abs(ratio - 1.0) > config.clip
    return -jnp.mean(gain), {
        "ppo/policy_loss": -jnp.mean(gain),
        # E[(r - 1) - log r]: unbiased, never negative (Schulman 2020).
        # Before the step it belongs to: zero in the first of an update.
        "ppo/kl": jnp.mean(ratio - 1.0 - log_ratio),
        "ppo/clip_fraction": jnp.mean(outside.astype(jnp.float32)),
    }


def value_loss(
    params: networks.Mlp, batch: Batch, config: PpoConfig
) -> tuple[Array, dict[str, Array]]:
    """Half the squared error [] against the returns, in units of 1 / (1 - gamma)."""
    value = value_of(params, batch.obs, config.discount)
    error = (value - batch.target) / _value_scale(config.discount)
    loss = 0.5 * jnp.mean(error**2)
    return loss, {"ppo/value_loss": loss}


def update(
    key: Array, agent: Agent, batch: Batch, config: PpoConfig, axis_name: str
) -> tuple[Agent, dict[str, Array]]:
    """All epochs over the tuples of this device, shuffled anew for each.

    Args:
        key: of this device; consumed.
        agent: before.
        batch: this device's tuples.
        config: sizes and weights.
        axis_name: mesh axis over which gradients are averaged.

    Returns:
        The agent after, and this device's metrics averaged over the steps; steps whose
        gradient is not finite are left out and counted in `ppo/skipped`.
    """
    tuples = batch.log_prob.shape[0]
    size = config.minibatch_size // jax.lax.axis_size(axis_name)
    # Sorting random numbers is one operation; `jax.random.permutation` is a dozen.
    shuffles = jnp.argsort(jax.random.bits(key, (config.epochs, tuples)), axis=-1)
    rows = shuffles.reshape(config.epochs * tuples // size, size)

    def step(agent: Agent, rows: Array) -> tuple[Agent, dict[str, Array]]:
        minibatch = jax.tree.map(lambda x: x[rows], batch)
        return _step(agent, minibatch, config, axis_name)

    agent, metrics = jax.lax.scan(step, agent, rows)
    skipped = jnp.sum(metrics.pop("ppo/skipped"))
    return agent, jax.tree.map(jnp.mean, metrics) | {
        "ppo/skipped": skipped,
        "ppo/learning_rate": networks.learning_rate(agent.policy),
    }


def _step(
    agent: Agent, batch: Batch, config: PpoConfig, axis_name: str
) -> tuple[Agent, dict[str, Array]]:
    policy_optimizer, value_optimizer = make_optimizers(config)
    policy_gradient, of_policy = jax.grad(policy_loss, has_aux=True)(
        agent.policy.params, batch, config
    )
    value_gradient, of_value = jax.grad(value_loss, has_aux=True)(
        agent.value.params, batch, config
    )
    policy_gradient, value_gradient, kl = mean_tree(
        (policy_gradient, value_gradient, of_policy["ppo/kl"]), axis_name
    )
    rate = _adapted(networks.learning_rate(agent.policy), kl, config.target_kl)
    policy = networks.with_learning_rate(agent.policy, rate)
    policy, skipped_policy = networks.apply_gradients(
        policy, policy_gradient, policy_optimizer
    )
    value, skipped_value = networks.apply_gradients(
        agent.value, value_gradient, value_optimizer
    )
    skipped = {"ppo/skipped": jnp.maximum(skipped_policy, skipped_value)}
    return Agent(policy=policy, value=value), of_policy | of_value | skipped


def _adapted(rate: Array, kl: Array, target: float | None) -> Array:
    if target is None:
        return rate
    # A divergence that is not a number leaves the rate as it is.
    factor = jnp.where(kl > 2.0 * target, 1 / 1.5, 1.0)
    factor = jnp.where(kl < 0.5 * target, 1.5, factor)
    return jnp.clip(rate * factor, _MIN_LEARNING_RATE, _MAX_LEARNING_RATE)


def _value_scale(discount: float) -> float:
    return 1.0 / max(1.0 - discount, 1e-3)


def _require(ok: bool, name: str, value: object, allowed: str) -> None:
    if not ok:
        raise ValueError(f"ppo.{name} must be {allowed}, got {value}")
