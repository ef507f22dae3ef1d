"""Random numbers that belong together, drawn at once.

Every draw brings loops of its own, which LLVM compiles for about a second
(docs/performance.md). So whoever needs several numbers draws them in one go.
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
