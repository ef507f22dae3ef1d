"""Random numbers that belong together, drawn at once.

Every draw is a program of its own to XLA, and costs more time to compile than most of
what is done with its numbers. So whoever needs several numbers draws them in one go.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

Array = jax.Array


def uniform(key: Array, *ranges: tuple[float, float]) -> Array:
    """One number from each of R ranges (least, greatest), [R].

    Args:
        key: consumed.
        ranges: the greatest itself is left out.
    """
    least, greatest = jnp.array(ranges, jnp.float32).T
    return least + (greatest - least) * jax.random.uniform(key, (len(ranges),))
