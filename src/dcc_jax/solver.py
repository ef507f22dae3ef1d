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
[..., B], and an unknown vector is a `Split`: the limbs' parts and the core's.

Letters: R rows; G limbs of a stack, n unknowns each, coupled with k of the core's c.
Loops are rolled on purpose: XLA's CPU backend fuses unrolled recurrences into ever
larger kernels, which compute the same numbers again and again (docs/performance.md).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.sparsity import BLOCK, Arrow, Stack

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


class Split(NamedTuple):
    """A vector of the scene's unknowns."""

    limbs: tuple[Array, ...]  # one [G, n, B] a stack
    core: Array  # [c, B]


class Fronts(NamedTuple):
    """A matrix in the arrow's shape: what couples limb and core is in the limb's."""

    limbs: tuple[Array, ...]  # one [G, n + k, n + k, B] a stack
    core: Array  # [c, c, B]


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
    order = _row_order(shape)
    J_parts = _row_parts(shape, J)
    D, aref = _take(D, order), _take(aref, order)
    always = jnp.asarray(order < num_equality)[:, None]
    M = _fronts(shape, mass)
    smooth_parts = _split(shape, smooth)

    def active(residual: Array) -> Array:
        return always | (residual < 0)

    def weights(residual: Array) -> Array:
        return jnp.where(active(residual), D, 0.0)

    def system(residual: Array, mass_qacc: Split) -> tuple[Fronts, Split, Split]:
        gauss = jax.tree.map(jnp.subtract, mass_qacc, smooth_parts)
        weight = weights(residual)
        return *_assembled(shape, M, gauss, J_parts, weight, residual), gauss

    def unfinished(carry: tuple) -> Array:
        count, done, *_ = carry
        return (count < iterations) & ~jnp.all(done)

    # The linear system is carried from one iteration into the next, and so computed
    # once: XLA would compute parts of it again wherever the factorization needs them.
    def iterated(carry: tuple) -> tuple:
        count, done, qacc, residual, mass_qacc, (H, gradient, gauss) = carry
        downhill = jax.tree.map(lambda g: -g[..., None, :], gradient)
        search = _solve(shape, H, downhill)
        search = jax.tree.map(lambda x: x[..., 0, :], search)
        slope = _rows_times(shape, J_parts, search)
        mass_search = _times(shape, M, search)
        step = _line_search(
            weights, residual, slope, _dot(search, gauss), _dot(search, mass_search)
        )
        step = jnp.where(done, 0.0, step)
        moved = residual + step * slope
        same = jnp.all(active(moved) == active(residual), axis=0)
        # Written so that what is not a number is done as well.
        done = done | (same & ~(jnp.abs(step - 1.0) > FULL_STEP))
        qacc = jax.tree.map(lambda a, d: a + step * d, qacc, search)
        mass_qacc = jax.tree.map(lambda a, d: a + step * d, mass_qacc, mass_search)
        return count + 1, done, qacc, moved, mass_qacc, system(moved, mass_qacc)

    qacc = _split(shape, start)
    residual = _rows_times(shape, J_parts, qacc) - aref
    mass_qacc = _times(shape, M, qacc)
    carry = (
        jnp.zeros((), jnp.int32),
        jnp.zeros(residual.shape[-1], bool),
        qacc,
        residual,
        mass_qacc,
        system(residual, mass_qacc),
    )
    _, _, qacc, residual, *_ = jax.lax.while_loop(unfinished, iterated, carry)
    force = -weights(residual) * residual
    back = np.empty(shape.num_rows, int)
    real = order < shape.num_rows
    back[order[real]] = np.flatnonzero(real)
    return _joined(shape, qacc), force[back]


def _solve_mass(shape: Arrow, less: np.ndarray, mass: Array, forces: Array) -> Array:
    fronts = _fronts(shape, mass)
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
    true = Fronts(tuple(limbs), without(fronts.core, shape.core))
    return _joined(shape, _solve(shape, true, _split(shape, forces)))


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


# --- the arrow's shape: taking vectors and matrices apart, and together ---


def _row_order(shape: Arrow) -> np.ndarray:
    """Rows stack after stack, then the core's; R stands for padding."""
    limbs = [stack.rows.ravel() for stack in shape.stacks]
    return np.concatenate([*limbs, shape.core_rows]).astype(int)


def _take(x: Array, index: np.ndarray) -> Array:
    """x[index] along the first axis, zero where the index is one past the end.

    Slices, one for each run of neighbours: a gather costs five times as much.
    """
    flat = index.ravel()
    parts = []
    for run in np.split(flat, np.flatnonzero(np.diff(flat) != 1) + 1):
        if run.size:
            parts.append(x[run[0] : run[-1] + 1])
        if run.size and run[-1] == x.shape[0]:
            parts.append(jnp.zeros((1, *x.shape[1:]), x.dtype))
    if not parts:
        return jnp.zeros((*index.shape, *x.shape[1:]), x.dtype)
    return jnp.concatenate(parts).reshape(*index.shape, *x.shape[1:])


def _split(shape: Arrow, x: Array) -> Split:
    limbs = tuple(_take(x, stack.dofs) for stack in shape.stacks)
    return Split(limbs, _take(x, shape.core))


def _joined(shape: Arrow, x: Split) -> Array:
    """The inverse of `_split`, [nv, B]."""
    index = np.concatenate([*(s.dofs.ravel() for s in shape.stacks), shape.core])
    parts = [part.reshape(-1, *part.shape[2:]) for part in x.limbs]
    real = index < shape.nv
    back = np.empty(shape.nv, int)
    back[index[real]] = np.flatnonzero(real)
    return jnp.concatenate([*parts, x.core])[back]


def _fronts(shape: Arrow, mass: Array) -> Fronts:
    """M [nv, nv, B] in its parts; a limb's front leaves what is the core's to it."""
    core = np.append(shape.core, shape.nv)

    def front(dofs: np.ndarray, coupled: np.ndarray) -> Array:
        own = _take(mass, dofs)
        inner = _take(own.swapaxes(0, 1), dofs).swapaxes(0, 1)
        outer = _take(own.swapaxes(0, 1), core[coupled])
        top = jnp.concatenate([inner, outer.swapaxes(0, 1)], axis=1)
        bottom = jnp.pad(outer, ((0, 0), (0, len(coupled)), (0, 0)))
        return jnp.concatenate([top, bottom])

    limbs = []
    for stack in shape.stacks:
        parts = [front(d, c) for d, c in zip(stack.dofs, stack.core, strict=True)]
        limbs.append(_with_identity(jnp.stack(parts), stack.identity))
    own = _take(_take(mass, shape.core).swapaxes(0, 1), shape.core).swapaxes(0, 1)
    return Fronts(tuple(limbs), _with_identity(own, shape.core_identity))


def _with_identity(front: Array, identity: np.ndarray) -> Array:
    """Ones where a padded unknown is its own."""
    if not identity.any():
        return front
    return front + jnp.asarray(identity, front.dtype)[..., None]


def _row_parts(shape: Arrow, J: Array) -> Split:
    """The rows' non-zero columns: a stack's [G, r, n + k, B], the core's [r, c, B]."""
    core = np.append(shape.core, shape.nv)
    columns = J.swapaxes(0, 1)

    def block(rows: np.ndarray, dofs: np.ndarray) -> Array:
        return _take(_take(columns, dofs).swapaxes(0, 1), rows)

    def part(stack: Stack) -> Array:
        seen = np.concatenate([stack.dofs, core[stack.core]], axis=1)
        return jnp.stack([block(r, s) for r, s in zip(stack.rows, seen, strict=True)])

    own = block(shape.core_rows, shape.core)
    return Split(tuple(part(stack) for stack in shape.stacks), own)


def _with_core(stack: Stack, limbs: Array, core: Array) -> Array:
    """The unknowns [G, n + k, B] that the fronts of a stack see."""
    return jnp.concatenate([limbs, _take(core, stack.core)], axis=1)


def _add_to_core(
    stack: Stack, core: Array, parts: Array, matrix: bool = False
) -> Array:
    """core plus what every limb has for it; core [c, ...] and parts [G, k, ...].

    With `matrix` it is [c, c, B] and [G, k, k, B].
    """
    for columns, part in zip(stack.core, parts, strict=True):
        real = np.flatnonzero(columns < core.shape[0])
        target = columns[real]
        if matrix:
            core = core.at[target[:, None], target].add(part[real[:, None], real])
        else:
            core = core.at[target].add(part[real])
    return core


# --- products and sums ---


def _dot(a: Split, b: Split) -> Array:
    """[B]"""
    products = jax.tree.map(lambda x, y: (x * y).reshape(-1, x.shape[-1]), a, b)
    return sum(jnp.sum(x, axis=0) for x in jax.tree.leaves(products))  # pyright: ignore


def _matvec(A: Array, x: Array) -> Array:
    """A [..., i, j, B] times x [..., j, B], written out: one fused kernel."""
    terms = [A[..., j, :] * x[..., None, j, :] for j in range(x.shape[-2])]
    return functools.reduce(jnp.add, terms)


def _times(shape: Arrow, A: Fronts, x: Split) -> Split:
    """A x."""
    core = _matvec(A.core, x.core)
    limbs = []
    for stack, front, part in zip(shape.stacks, A.limbs, x.limbs, strict=True):
        product = _matvec(front, _with_core(stack, part, x.core))
        size = part.shape[1]
        limbs.append(product[:, :size])
        core = _add_to_core(stack, core, product[:, size:])
    return Split(tuple(limbs), core)


def _rows_times(shape: Arrow, J: Split, x: Split) -> Array:
    """J x in the order of `_row_order`."""
    parts = []
    for stack, rows, part in zip(shape.stacks, J.limbs, x.limbs, strict=True):
        product = _matvec(rows, _with_core(stack, part, x.core))
        parts.append(product.reshape(-1, product.shape[-1]))
    return jnp.concatenate([*parts, _matvec(J.core, x.core)])


def _assembled(
    shape: Arrow, M: Fronts, gauss: Split, J: Split, weight: Array, residual: Array
) -> tuple[Fronts, Split]:
    """H = M + J^T W J and the gradient, gauss + J^T W residual."""
    fronts, limbs, core_gradient, begin = [], [], gauss.core, 0
    for stack, front, own, rows in zip(
        shape.stacks, M.limbs, gauss.limbs, J.limbs, strict=True
    ):
        count, depth = rows.shape[:2]
        end = begin + count * depth
        shaped = count, depth, weight.shape[-1]
        w, res = (x[begin:end].reshape(shaped) for x in (weight, residual))
        begin = end
        gradient = jnp.pad(own, ((0, 0), (0, stack.core.shape[1]), (0, 0)))
        front, gradient = _outer_sums(front, gradient, rows, w, res)
        fronts.append(front)
        limbs.append(gradient[:, : own.shape[1]])
        core_gradient = _add_to_core(stack, core_gradient, gradient[:, own.shape[1] :])
    core, core_gradient = _outer_sums(
        M.core[None],
        core_gradient[None],
        J.core[None],
        weight[None, begin:],
        residual[None, begin:],
    )
    return Fronts(tuple(fronts), core[0]), Split(tuple(limbs), core_gradient[0])


def _outer_sums(
    A: Array, b: Array, rows: Array, weight: Array, residual: Array
) -> tuple[Array, Array]:
    """A [G, m, m, B] + sum_r w r r^T and b [G, m, B] + sum_r w r residual."""
    weighted = weight[:, :, None] * rows
    for i in range(rows.shape[1]):
        A = A + weighted[:, i, :, None] * rows[:, i, None, :]
        b = b + weighted[:, i] * residual[:, i, None]
    return A, b


# --- the factorization ---


def _solve(shape: Arrow, A: Fronts, b: Split) -> Split:
    """A^-1 b for F right sides: parts [..., F, B].

    The limbs are eliminated, then the core is solved, then the limbs.
    """
    core, core_b = A.core, b.core
    eliminated = []
    for stack, front, limb_b in zip(shape.stacks, A.limbs, b.limbs, strict=True):
        y = jnp.pad(limb_b, ((0, 0), (0, stack.core.shape[1]), (0, 0), (0, 0)))
        factor, front, y = _eliminate(front, y, limb_b.shape[1])
        eliminated.append(factor)
        core = _add_to_core(stack, core, front, matrix=True)
        core_b = _add_to_core(stack, core_b, y)
    factor, _, _ = _eliminate(core[None], core_b[None], core.shape[0])
    x_core = _substitute(factor, core_b[None, :0])[0]
    limbs = tuple(
        _substitute(factor, _take(x_core, stack.core))
        for stack, factor in zip(shape.stacks, eliminated, strict=True)
    )
    return Split(limbs, x_core)


def _eliminate(A: Array, b: Array, size: int) -> tuple[list, Array, Array]:
    """Block elimination of the first `size` unknowns of A x = b, F right sides.

    A [G, m, m, B] is symmetric positive definite, which needs no pivoting.

    Returns:
        per block the couplings (BLOCK of [G, rest, B]) and right sides (BLOCK of
        [G, F, B]) of x_i = right_i - coupling_i x_rest, then the Schur complement and
        its right sides.
    """
    factor = []
    for _ in range(size // BLOCK):
        pivot = [[A[:, i, j] for i in range(BLOCK)] for j in range(BLOCK)]
        panel = [A[:, i, BLOCK:] for i in range(BLOCK)]
        coupling = _solve_3(pivot, panel)
        right = _solve_3(pivot, [b[:, i] for i in range(BLOCK)])
        A, b = A[:, BLOCK:, BLOCK:], b[:, BLOCK:]
        for p, c, r in zip(panel, coupling, right, strict=True):
            A = A - p[:, :, None] * c[:, None]
            b = b - p[:, :, None] * r[:, None]
        factor.append((coupling, right))
    return factor, A, b


def _substitute(factor: list, rest: Array) -> Array:
    """The unknowns [G, m, F, B] that belong to those of the rest [G, k, F, B]."""
    x = [rest[:, i] for i in range(rest.shape[1])]
    known = len(x)
    for coupling, right in reversed(factor):
        own = []
        for c, r in zip(coupling, right, strict=True):
            own.append(r - sum(c[:, j, None] * value for j, value in enumerate(x)))
        x = own + x
    return jnp.stack(x[: len(x) - known], axis=1)


def _solve_3(P: list[list[Array]], y: list[Array]) -> list[Array]:
    """P^-1 y for P symmetric [3][3] of [G, B] and y [3] of [G, m, B].

    Each result ends in a division on purpose: XLA does not repeat one in every kernel
    that needs it.
    """
    p00, p01, p02 = (P[0][i][:, None] for i in range(3))
    p11, p12, p22 = P[1][1][:, None], P[1][2][:, None], P[2][2][:, None]
    l01, l02 = p01 / p00, p02 / p00
    d1 = p11 - l01 * p01
    e12 = p12 - l01 * p02
    l12 = e12 / d1
    d2 = p22 - l02 * p02 - l12 * e12
    y1 = y[1] - l01 * y[0]
    x2 = (y[2] - l02 * y[0] - l12 * y1) / d2
    x1 = (y1 - e12 * x2) / d1
    return [(y[0] - p01 * x1 - p02 * x2) / p00, x1, x2]
