"""The adversarial motion network of Sec. 4.1, Eq. (12).

Letters: N pairs, F body features, C condition, M minibatches, W = 2 F + C inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.learn import networks, normalizer
from dcc_jax.learn.exchange import mean_tree

Array = jax.Array
LONGEST_SPAN = 90
"""Control steps, 3 s: every environment keeps as many states."""


@dataclass(frozen=True)
class DiscriminatorConfig:
    """The discriminator and how it learns."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of its hidden layers (Sec. 5.1)."""

    span: int = 1
    """Control steps between s and s'; the paper has consecutive ones (Sec. 4.1). Of an
    episode that is younger, s is its first state, and as many clip pairs are as far
    apart."""

    learning_rate: float = 1e-4
    """Step size of Adam (Sec. 5.1)."""

    minibatch_size: int = 256
    """Policy pairs, and as many clip pairs, in a step; the paper has 16 (Sec. 5.1)."""

    minibatches: int = 16
    """Steps per update; the paper does not say."""

    gradient_penalty: float = 50.0
    """Weight of |dD/d(s, s')|^2 on clip pairs (Sec. 5.1, without a number; Peng 2021
    has 10). A discriminator that is held back teaches more."""

    logit_penalty: float = 0.05
    """Weight of the last layer's squared kernel (Sec. 5.1; the value of Peng 2021)."""

    instance_noise: float = 0.3
    """Standard deviation of the noise on the normalised features of both sets while it
    learns (Sonderby 2017; not the paper's): what lies closer cannot be told apart."""

    feature_floor: float = 0.1
    """Least standard deviation that a feature is divided by, m (or a unit vector's
    entry; not the paper's). The millimetres of a nearly still clip stay small."""

    max_gradient_norm: float = 1.0
    """Longer gradients are scaled down to this norm (usual; not the paper's)."""

    def __post_init__(self) -> None:
        for name in ("learning_rate", "max_gradient_norm", "feature_floor"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "positive")
        for name in ("gradient_penalty", "logit_penalty", "instance_noise"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        _require(1 <= self.span <= LONGEST_SPAN, "span", self.span, "1 to 90")
        for name in ("minibatch_size", "minibatches"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")
        positive = all(width > 0 for width in self.hidden)
        _require(positive, "hidden", self.hidden, "positive widths")


@flax.struct.dataclass
class Pairs:
    """Features at two moments, of a clip or of the policy."""

    s: Array  # [N, F] earlier
    s_next: Array  # [N, F] `DiscriminatorConfig.span` control steps later
    condition: Array  # [N, C] clip label or phase; C may be 0


def inputs(
    n: normalizer.Normalizer, pairs: Pairs, config: DiscriminatorConfig
) -> Array:
    """What the network sees of pairs, [N, W]: features normalised, then condition."""
    floor = config.feature_floor
    return jnp.concatenate(
        [
            normalizer.normalize(n, pairs.s, floor),
            normalizer.normalize(n, pairs.s_next, floor),
            pairs.condition,
        ],
        axis=-1,
    )


def blurred(key: Array, x: Array, size: int, config: DiscriminatorConfig) -> Array:
    """Inputs x [..., W] with instance noise on the features of both s and s' [size]."""
    noise = jax.random.normal(key, (*x.shape[:-1], 2 * size), x.dtype)
    return x.at[..., : 2 * size].add(config.instance_noise * noise)


def score(params: networks.Mlp, x: Array) -> Array:
    """D(s, s') [...] for inputs x [..., W]; 1 on clips, -1 on the policy (Eq. (12))."""
    return networks.apply_mlp(params, x)[..., 0]


def gradient_penalty(params: networks.Mlp, x: Array) -> Array:
    """E |dD/dx|^2 over clip inputs x [N, W], [].

    Departure: the paper cites Gulrajani 2017, who pulls the norm to 1 between the two
    sets; for a least-squares D at the data's optimum the slope is zero (Peng 2021).
    """
    slope = jax.grad(lambda at: jnp.sum(score(params, at)))(x)
    return jnp.mean(jnp.sum(slope * slope, axis=-1))


def loss(
    params: networks.Mlp, expert: Array, policy: Array, config: DiscriminatorConfig
) -> tuple[Array, dict[str, Array]]:
    """Eq. (12) with gradient penalty and last-layer penalty.

    Args:
        params: of the discriminator.
        expert: inputs of clip pairs, [N, W].
        policy: inputs of policy pairs, [N, W].
        config: the weights.

    Returns:
        The loss [] and scalar metrics.
    """
    # One pass over both halves costs less than two.
    d = score(params, jnp.concatenate([expert, policy]))
    d_expert, d_policy = jnp.split(d, [expert.shape[0]])
    least_squares = jnp.mean((d_expert - 1.0) ** 2) + jnp.mean((d_policy + 1.0) ** 2)
    penalty = gradient_penalty(params, expert)
    logit = jnp.sum(params.layers[-1].kernel ** 2)
    total = (
        least_squares
        + 0.5 * config.gradient_penalty * penalty
        + config.logit_penalty * logit
    )
    return total, {"disc/loss": least_squares, "disc/gradient_penalty": penalty}


def judged(params: networks.Mlp, expert: Array, policy: Array) -> dict[str, Array]:
    """How well it tells inputs [N, W] without noise apart: the shares judged right, and
    the mean score of the clips less that of the policy (2 where it has won)."""
    d_expert, d_policy = score(params, expert), score(params, policy)
    return {
        "disc/accuracy_real": jnp.mean(d_expert > 0.0),
        "disc/accuracy_fake": jnp.mean(d_policy < 0.0),
        "disc/margin": jnp.mean(d_expert) - jnp.mean(d_policy),
    }


def make_optimizer(config: DiscriminatorConfig) -> networks.Optimizer:
    """Adam with the discriminator's step size."""
    return networks.clipped_adam(config.learning_rate, config.max_gradient_norm)


def update(
    network: networks.Network,
    expert: Array,
    policy: Array,
    config: DiscriminatorConfig,
    axis_name: str,
) -> tuple[networks.Network, dict[str, Array]]:
    """Descends once per minibatch, gradients averaged over the devices of the axis.

    Args:
        network: before.
        expert: clip inputs of this device, [M, N, W].
        policy: policy inputs of this device, [M, N, W].
        config: weights and step size.
        axis_name: mesh axis of the devices.

    Returns:
        The network after M steps, and this device's metrics averaged over them; a step
        whose gradient is not finite is left out and counted in `disc/skipped`.
    """
    optimizer = make_optimizer(config)

    def step(
        network: networks.Network, batch: tuple[Array, Array]
    ) -> tuple[networks.Network, dict[str, Array]]:
        gradient, metrics = jax.grad(loss, has_aux=True)(network.params, *batch, config)
        gradient = mean_tree(gradient, axis_name)
        network, skipped = networks.apply_gradients(network, gradient, optimizer)
        return network, metrics | {"disc/skipped": skipped}

    network, metrics = jax.lax.scan(step, network, (expert, policy))
    skipped = jnp.sum(metrics.pop("disc/skipped"))
    return network, jax.tree.map(jnp.mean, metrics) | {"disc/skipped": skipped}


def _require(ok: bool, name: str, value: object, allowed: str) -> None:
    if not ok:
        raise ValueError(f"disc.{name} must be {allowed}, got {value}")
