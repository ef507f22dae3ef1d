"""The contact solver: Newton on MuJoCo's constrained acceleration problem.

MuJoCo's forward dynamics with soft constraints is the convex problem

    min_a  1/2 (a - a0)^T M (a - a0) + sum_i s_i(J_i a - aref_i),

where s_i is the quadratic 1/2 D x^2, for inequality rows (contact pyramid edges,
limits) only where x < 0. Its gradient is piecewise linear: a full Newton step that ends
among the same active rows has arrived, and there the iteration stops. Most steps need
one or two iterations from the last step's solution, a hard landing up to eight.

The public functions are written for ONE environment. Under `vmap` they run with the
batch as the LAST axis, so that a CPU's vector units work on many environments at once,
and on the limbs of one size side by side (`sparsity`). Inside, every array is
[..., B], and an unknown vector is an `arrow.Split`: the limbs' parts and the core's.

Letters: R rows. Loops are rolled on purpose (`arrow`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.physics import arrowhead
from dcc_jax.physics.sparsity import Arrow

Array = jax.Array
LINE_SEARCH_ITERATIONS = 4
FULL_STEP = 1e-3  # a step so close to 1 is a whole one


@flax.struct.dataclass
class Rows:
    """Constraint rows: R of them, the first `num_equality` always active."""

    J: Array  # [R, nv]
    D: Array  # [R] inverse of the row's regularization
    aref: Array  # [R] reference acceleration
    num_equality: int = flax.struct.field(pytree_node=False)


def newton(
    shape: Arrow, mass: Array, smooth: Array, rows: Rows, start: Array, iterations: int
) -> tuple[Array, Array]:
    """Accelerations [nv] and row forces [R].

    Args:
        shape: of the scene's matrices.
        mass: M [nv, nv], what multiplies the acceleration.
        smooth: all other generalized forces [nv].
        rows: the constraints.
        start: accelerations to start from [nv], e.g. the last step's.
        iterations: the most Newton iterations; the batch goes on until its last
            environment has converged, those that have stay as they are.
    """
    solve = _batch_last(
        functools.partial(_newton, shape, rows.num_equality, iterations)
    )
    return solve(mass, smooth, rows.J, rows.D, rows.aref, start)


def solve_mass(shape: Arrow, mass: Array, less: np.ndarray, forces: Array) -> Array:
    """(M - diag(less))^-1 f for M [nv, nv] and every f of forces [F, nv]: [F, nv].

    The difference is taken of its parts, which `newton` has of M as well.
    """
    solve = _batch_last(functools.partial(_solve_mass, shape, less))
    return solve(mass, forces.T).T


def _batch_last(function: Callable) -> Callable:
    """`function` of arrays [..., B] as one of arrays without a batch; vmap gives B."""

    @jax.custom_batching.custom_vmap
    def one(*args: Array):
        out = function(*(x[..., None] for x in args))
        return jax.tree.map(lambda x: x[..., 0], out)

    @one.def_vmap
    def many(size: int, batched: list[bool], *args: Array):
        args = tuple(
            jnp.moveaxis(x, 0, -1)
            if has
            else jnp.broadcast_to(x[..., None], (*x.shape, size))
            for x, has in zip(args, batched, strict=True)
        )
        out = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), function(*args))
        return out, jax.tree.map(lambda _: True, out)

    return one


class _System(NamedTuple):
    """H d = -gradient of a Newton iteration."""

    H: arrowhead.Fronts
    gradient: arrowhead.Split
    gauss: arrowhead.Split  # M a - smooth, the gradient without the constraints'


class _Iterate(NamedTuple):
    """Carried from iteration to iteration, with the linear system of the next: computed
    once, where XLA would compute parts of it again wherever the factorization needs
    them."""

    made: Array  # [] iterations
    done: Array  # [B] converged
    qacc: arrowhead.Split
    residual: Array  # [R, B] J a - aref
    mass_qacc: arrowhead.Split  # M a
    system: _System


@dataclass(frozen=True)
class _Problem:
    """What stays the same in all iterations; rows in the arrow's order."""

    shape: Arrow
    M: arrowhead.Fronts
    smooth: arrowhead.Split
    J: arrowhead.Split
    D: Array  # [R, B]
    always: Array  # [R, 1] of an equality

    def active(self, residual: Array) -> Array:
        return self.always | (residual < 0)

    def weights(self, residual: Array) -> Array:
        return jnp.where(self.active(residual), self.D, 0.0)

    def system(self, residual: Array, mass_qacc: arrowhead.Split) -> _System:
        gauss = jax.tree.map(jnp.subtract, mass_qacc, self.smooth)
        weight = self.weights(residual)
        H, gradient = arrowhead.assembled(
            self.shape, self.M, gauss, self.J, weight, residual
        )
        return _System(H, gradient, gauss)

    def started(self, qacc: arrowhead.Split, aref: Array) -> _Iterate:
        residual = arrowhead.rows_times(self.shape, self.J, qacc) - aref
        mass_qacc = arrowhead.times(self.shape, self.M, qacc)
        return _Iterate(
            made=jnp.zeros((), jnp.int32),
            done=jnp.zeros(residual.shape[-1], bool),
            qacc=qacc,
            residual=residual,
            mass_qacc=mass_qacc,
            system=self.system(residual, mass_qacc),
        )

    def iterated(self, at: _Iterate) -> _Iterate:
        shape, system = self.shape, at.system
        downhill = jax.tree.map(lambda g: -g[..., None, :], system.gradient)
        search = arrowhead.solve(shape, system.H, downhill)
        search = jax.tree.map(lambda x: x[..., 0, :], search)
        slope = arrowhead.rows_times(shape, self.J, search)
        mass_search = arrowhead.times(shape, self.M, search)
        step = _line_search(
            self.weights,
            at.residual,
            slope,
            arrowhead.dot(search, system.gauss),
            arrowhead.dot(search, mass_search),
        )
        step = jnp.where(at.done, 0.0, step)
        residual = at.residual + step * slope
        same = jnp.all(self.active(residual) == self.active(at.residual), axis=0)
        mass_qacc = jax.tree.map(lambda a, d: a + step * d, at.mass_qacc, mass_search)
        return _Iterate(
            made=at.made + 1,
            # Written so that what is not a number is done as well.
            done=at.done | (same & ~(jnp.abs(step - 1.0) > FULL_STEP)),
            qacc=jax.tree.map(lambda a, d: a + step * d, at.qacc, search),
            residual=residual,
            mass_qacc=mass_qacc,
            system=self.system(residual, mass_qacc),
        )


def _newton(
    shape: Arrow,
    num_equality: int,
    iterations: int,
    mass: Array,
    smooth: Array,
    J: Array,
    D: Array,
    aref: Array,
    start: Array,
) -> tuple[Array, Array]:
    order = arrowhead.row_order(shape)
    problem = _Problem(
        shape=shape,
        M=arrowhead.fronts(shape, mass),
        smooth=arrowhead.split(shape, smooth),
        J=arrowhead.row_parts(shape, J),
        D=arrowhead.take(D, order),
        always=jnp.asarray(order < num_equality)[:, None],
    )

    def unfinished(at: _Iterate) -> Array:
        return (at.made < iterations) & ~jnp.all(at.done)

    first = problem.started(arrowhead.split(shape, start), arrowhead.take(aref, order))
    last = jax.lax.while_loop(unfinished, problem.iterated, first)
    force = -problem.weights(last.residual) * last.residual
    in_order = force[arrowhead.places(order, shape.num_rows)]
    return arrowhead.joined(shape, last.qacc), in_order


def _solve_mass(shape: Arrow, less: np.ndarray, mass: Array, forces: Array) -> Array:
    fronts = arrowhead.fronts(shape, mass)
    less = np.append(less, 0.0)

    def without(front: Array, dofs: np.ndarray) -> Array:
        size = front.shape[-2] - dofs.shape[-1]
        diagonal = np.pad(less[dofs], [(0, 0)] * (dofs.ndim - 1) + [(0, size)])
        own = np.eye(front.shape[-2]) * diagonal[..., None]
        return front - jnp.asarray(own, front.dtype)[..., None]

    limbs = (
        without(front, stack.dofs)
        for stack, front in zip(shape.stacks, fronts.limbs, strict=True)
    )
    true = arrowhead.Fronts(tuple(limbs), without(fronts.core, shape.core))
    return arrowhead.joined(
        shape, arrowhead.solve(shape, true, arrowhead.split(shape, forces))
    )


def _line_search(
    weights: Callable, residual: Array, slope: Array, gauss_1: Array, gauss_2: Array
) -> Array:
    """The step [B] that minimizes the cost along the search direction.

    Its derivative is increasing and piecewise linear; Newton from 1 lands on the right
    piece within a few steps, kept inside the bracket found so far.
    """

    def narrowed(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        low, high, t = carry
        x = residual + t * slope
        weighted = weights(x) * slope
        first = gauss_1 + t * gauss_2 + jnp.sum(weighted * x, axis=0)
        second = gauss_2 + jnp.sum(weighted * slope, axis=0)
        low = jnp.where(first < 0, t, low)
        high = jnp.where(first < 0, high, t)
        proposed = t - first / jnp.maximum(second, 1e-12)
        inside = (proposed >= low) & (proposed <= high)
        return low, high, jnp.where(inside, proposed, 0.5 * (low + high))

    one = jnp.ones_like(gauss_1)
    return jax.lax.fori_loop(
        0, LINE_SEARCH_ITERATIONS, narrowed, (0 * one, 4 * one, one)
    )[2]
