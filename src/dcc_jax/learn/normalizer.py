"""Running mean and variance of observations, stable in float32.

Letters: N samples, O observation size.
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


def init_normalizer(x: Array, axis_name: str | None = None) -> Normalizer:
    """Moments of a first batch x [N, O], over all devices of the axis."""
    count, mean, variance = _moments(x, axis_name)
    return Normalizer(count=count, mean=mean, variance=variance)


def update(n: Normalizer, x: Array, axis_name: str | None = None) -> Normalizer:
    """Merges the moments of a batch x [N, O] (Chan, Golub, LeVeque 1979).

    The moments of two sets are combined through their difference of means, so no large
    sums are ever subtracted.
    """
    count, mean, variance = _moments(x, axis_name)
    total = n.count + count
    delta = mean - n.mean
    share = count / total
    return Normalizer(
        count=total,
        mean=n.mean + delta * share,
        variance=n.variance
        + (variance - n.variance) * share
        + delta * delta * share * (1.0 - share),
    )


def normalize(n: Normalizer, x: Array) -> Array:
    """(x - mean) / std of x [..., O], clipped to +-10."""
    std = jnp.maximum(jnp.sqrt(n.variance), MIN_STD)
    return jnp.clip((x - n.mean) / std, -CLIP, CLIP)


def _moments(x: Array, axis_name: str | None) -> tuple[Array, Array, Array]:
    def over_devices(local: Array) -> Array:
        return local if axis_name is None else jax.lax.pmean(local, axis_name)

    devices = 1 if axis_name is None else jax.lax.axis_size(axis_name)
    mean = over_devices(jnp.mean(x, axis=0))
    variance = over_devices(jnp.mean((x - mean) ** 2, axis=0))
    return jnp.asarray(x.shape[0] * devices, jnp.float32), mean, variance
