"""Products and solutions of matrices so small that a library call costs more.

Letters: F forces, 3 components, nv velocities.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

Array = jax.Array


def times(A: Array, v: Array) -> Array:
    """A v [F, m] of A [F, m, n] and v [F, n]."""
    return jnp.sum(A * v[:, None, :], axis=-1)


def transpose_times(J: Array, x: Array) -> Array:
    """J^T x [F, nv] of J [F, 3, nv] and x [F, 3]."""
    return jnp.sum(J * x[:, :, None], axis=1)


def norm(v: Array) -> Array:
    """|v| [...] of v [..., n]."""
    return jnp.sqrt(jnp.sum(jnp.square(v), axis=-1))


def shorten(v: Array, bound: Array) -> Array:
    """v [..., n] scaled down to the norm `bound` where it is longer."""
    length = norm(v)
    longer = length > bound
    return v * jnp.where(longer, bound / jnp.where(longer, length, 1.0), 1.0)[..., None]


def solve_damped(A: Array, damping: float, b: Array) -> Array:
    """(A + damping I)^-1 b for positive semidefinite A [..., 3, 3], b [..., 3].

    A = U^T D U written out: `jnp.linalg` costs one LAPACK call an environment, and the
    adjugate loses all digits in float32 where two directions are singular.
    """
    d0 = A[..., 0, 0] + damping
    u01, u02 = A[..., 0, 1] / d0, A[..., 0, 2] / d0
    d1 = A[..., 1, 1] + damping - A[..., 0, 1] * u01
    d1 = jnp.maximum(d1, damping)
    u12 = (A[..., 1, 2] - A[..., 0, 1] * u02) / d1
    d2 = A[..., 2, 2] + damping - A[..., 0, 2] * u02 - d1 * u12 * u12
    d2 = jnp.maximum(d2, damping)
    y0 = b[..., 0]
    y1 = b[..., 1] - u01 * y0
    y2 = b[..., 2] - u02 * y0 - u12 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - u12 * x2
    x0 = y0 / d0 - u01 * x1 - u02 * x2
    return jnp.stack([x0, x1, x2], axis=-1)
