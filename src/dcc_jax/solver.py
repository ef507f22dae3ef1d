"""The contact solver: Newton on MuJoCo's constrained acceleration problem.

MuJoCo's forward dynamics with soft constraints is the convex problem

    min_a  1/2 (a - a0)^T M (a - a0) + sum_i s_i(J_i a - aref_i),

where s_i is the quadratic 1/2 D x^2, for inequality rows (contact pyramid edges,
limits) only where x < 0. Its gradient is piecewise linear, so Newton with an exact line
search converges in a few iterations. Their number is fixed and unrolled: under vmap a
`while_loop` would copy every environment's state in every iteration.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

Array = jax.Array
LINE_SEARCH_ITERATIONS = 6


@flax.struct.dataclass
class Rows:
    """Constraint rows: R of them, the first `num_equality` always active."""

    J: Array  # [R, nv]
    D: Array  # [R] inverse of the row's regularization
    aref: Array  # [R] reference acceleration
    num_equality: int = flax.struct.field(pytree_node=False)


def newton(
    mass: Array, smooth: Array, rows: Rows, start: Array, iterations: int
) -> tuple[Array, Array]:
    """Accelerations [nv] and row forces [R].

    Args:
        mass: M [nv, nv], what multiplies the acceleration.
        smooth: all other generalized forces [nv].
        rows: the constraints.
        start: accelerations to start from [nv], e.g. the last step's.
        iterations: Newton iterations, unrolled.
    """
    qacc = start
    residual = rows.J @ qacc - rows.aref
    mass_qacc = mass @ qacc
    for _ in range(iterations):
        active = _active(rows, residual)
        force = -active * rows.D * residual
        gradient = mass_qacc - smooth - rows.J.T @ force
        hessian = mass + (rows.J.T * (active * rows.D)) @ rows.J
        factor = jax.scipy.linalg.cho_factor(hessian)
        search = -jax.scipy.linalg.cho_solve(factor, gradient)
        slope, mass_search = rows.J @ search, mass @ search
        step = _line_search(
            rows,
            residual,
            slope,
            search @ (mass_qacc - smooth),
            search @ mass_search,
        )
        qacc += step * search
        residual += step * slope
        mass_qacc += step * mass_search
    return qacc, -_active(rows, residual) * rows.D * residual


def _active(rows: Rows, residual: Array) -> Array:
    always = jnp.arange(residual.shape[0]) < rows.num_equality
    return (always | (residual < 0)).astype(residual.dtype)


def _line_search(
    rows: Rows, residual: Array, slope: Array, gauss_1: Array, gauss_2: Array
) -> Array:
    """The step that minimizes the cost along the search direction.

    Its derivative is increasing and piecewise linear; Newton from 1 lands on the right
    piece within a few steps, kept inside the bracket found so far.
    """

    def derivatives(t: Array) -> tuple[Array, Array]:
        x = residual + t * slope
        weight = _active(rows, x) * rows.D * slope
        return gauss_1 + t * gauss_2 + weight @ x, gauss_2 + weight @ slope

    def narrowed(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        low, high, t = carry
        first, second = derivatives(t)
        low = jnp.where(first < 0, t, low)
        high = jnp.where(first < 0, high, t)
        proposed = t - first / jnp.maximum(second, 1e-12)
        inside = (proposed >= low) & (proposed <= high)
        return low, high, jnp.where(inside, proposed, 0.5 * (low + high))

    # A rolled loop: unrolled, XLA would fuse each reduction into the next one and
    # compute it again for every row.
    start = (jnp.zeros(()), jnp.full((), 4.0), jnp.ones(()))
    return jax.lax.fori_loop(0, LINE_SEARCH_ITERATIONS, narrowed, start)[2]
