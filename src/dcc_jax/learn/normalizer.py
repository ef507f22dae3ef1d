"""Running mean and variance of observations, stable in float32.

Letters: N samples, O observation size, D devices.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

Array = jax.Array

# Below this an entry counts as constant: log u is exactly zero until the first contact,
# and dividing by its spread would turn the first one into a jump to the clip.
MIN_STD = 1e-2
CLIP = 10.0


@flax.struct.dataclass
class Normalizer:
    """Moments of everything seen so far."""

    count: Array  # [] samples seen
    mean: Array  # [O]
    variance: Array  # [O]


def moments(x: Array) -> Normalizer:
    """Moments of samples x [N, O]."""
    mean = jnp.mean(x, axis=0)
    variance = jnp.mean((x - mean) ** 2, axis=0)
    return Normalizer(jnp.asarray(x.shape[0], jnp.float32), mean, variance)


def merge(n: Normalizer, more: Normalizer) -> Normalizer:
    """Moments of two sets together (Chan, Golub, LeVeque 1979).

    They are combined through their difference of means, so no large sums are ever
    subtracted.
    """
    total = n.count + more.count
    delta = more.mean - n.mean
    share = more.count / total
    return Normalizer(
        count=total,
        mean=n.mean + delta * share,
        variance=n.variance
        + (more.variance - n.variance) * share
        + delta * delta * share * (1.0 - share),
    )


def pooled(parts: Normalizer) -> Normalizer:
    """Moments of D equally large sets together, each leaf [D, ...]."""
    mean = jnp.mean(parts.mean, axis=0)
    variance = jnp.mean(parts.variance + (parts.mean - mean) ** 2, axis=0)
    return Normalizer(jnp.sum(parts.count), mean, variance)


def normalize(n: Normalizer, x: Array, floor: float = MIN_STD) -> Array:
    """(x - mean) / std of x [..., O], clipped to +-10; the std is `floor` or more."""
    std = jnp.maximum(jnp.sqrt(n.variance), floor)
    return jnp.clip((x - n.mean) / std, -CLIP, CLIP)
