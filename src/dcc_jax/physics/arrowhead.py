"""Vectors and matrices in the arrow's shape (`sparsity`): limbs that meet in a core.

Every array carries the batch B as its last axis. Limbs of one size are a stack and are
worked on side by side.

Letters: R rows; G limbs of a stack, n unknowns each, coupled with k of the core's c.
Loops are rolled on purpose: XLA's CPU backend fuses unrolled recurrences into ever
larger kernels, which compute the same numbers again and again (docs/performance.md).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.physics.sparsity import BLOCK, Arrow, Stack

Array = jax.Array


class Split(NamedTuple):
    """A vector of the scene's unknowns."""

    limbs: tuple[Array, ...]  # one [G, n, B] a stack
    core: Array  # [c, B]


class Fronts(NamedTuple):
    """A matrix in the arrow's shape: what couples limb and core is in the limb's."""

    limbs: tuple[Array, ...]  # one [G, n + k, n + k, B] a stack
    core: Array  # [c, c, B]


def row_order(shape: Arrow) -> np.ndarray:
    """Rows stack after stack, then the core's; R stands for padding."""
    limbs = [stack.rows.ravel() for stack in shape.stacks]
    return np.concatenate([*limbs, shape.core_rows]).astype(int)


def places(index: np.ndarray, size: int) -> np.ndarray:
    """Where each of `size` numbers stands in an index; `size` itself is padding."""
    real = index < size
    where = np.empty(size, int)
    where[index[real]] = np.flatnonzero(real)
    return where


def take(x: Array, index: np.ndarray) -> Array:
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


def split(shape: Arrow, x: Array) -> Split:
    limbs = tuple(take(x, stack.dofs) for stack in shape.stacks)
    return Split(limbs, take(x, shape.core))


def joined(shape: Arrow, x: Split) -> Array:
    """The inverse of `split`, [nv, B]."""
    index = np.concatenate([*(s.dofs.ravel() for s in shape.stacks), shape.core])
    parts = [part.reshape(-1, *part.shape[2:]) for part in x.limbs]
    return jnp.concatenate([*parts, x.core])[places(index, shape.nv)]


def fronts(shape: Arrow, mass: Array) -> Fronts:
    """M [nv, nv, B] in its parts; a limb's front leaves what is the core's to it."""
    core = np.append(shape.core, shape.nv)

    def front(dofs: np.ndarray, coupled: np.ndarray) -> Array:
        own = take(mass, dofs)
        inner = take(own.swapaxes(0, 1), dofs).swapaxes(0, 1)
        outer = take(own.swapaxes(0, 1), core[coupled])
        top = jnp.concatenate([inner, outer.swapaxes(0, 1)], axis=1)
        bottom = jnp.pad(outer, ((0, 0), (0, len(coupled)), (0, 0)))
        return jnp.concatenate([top, bottom])

    limbs = []
    for stack in shape.stacks:
        parts = [front(d, c) for d, c in zip(stack.dofs, stack.core, strict=True)]
        limbs.append(_with_identity(jnp.stack(parts), stack.identity))
    own = take(take(mass, shape.core).swapaxes(0, 1), shape.core).swapaxes(0, 1)
    return Fronts(tuple(limbs), _with_identity(own, shape.core_identity))


def _with_identity(front: Array, identity: np.ndarray) -> Array:
    """Ones where a padded unknown is its own."""
    if not identity.any():
        return front
    return front + jnp.asarray(identity, front.dtype)[..., None]


def row_parts(shape: Arrow, J: Array) -> Split:
    """The rows' non-zero columns: a stack's [G, r, n + k, B], the core's [r, c, B]."""
    core = np.append(shape.core, shape.nv)
    columns = J.swapaxes(0, 1)

    def block(rows: np.ndarray, dofs: np.ndarray) -> Array:
        return take(take(columns, dofs).swapaxes(0, 1), rows)

    def part(stack: Stack) -> Array:
        seen = np.concatenate([stack.dofs, core[stack.core]], axis=1)
        return jnp.stack([block(r, s) for r, s in zip(stack.rows, seen, strict=True)])

    own = block(shape.core_rows, shape.core)
    return Split(tuple(part(stack) for stack in shape.stacks), own)


def _with_core(stack: Stack, limbs: Array, core: Array) -> Array:
    """The unknowns [G, n + k, B] that the fronts of a stack see."""
    return jnp.concatenate([limbs, take(core, stack.core)], axis=1)


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


def dot(a: Split, b: Split) -> Array:
    """[B]"""
    products = jax.tree.map(lambda x, y: (x * y).reshape(-1, x.shape[-1]), a, b)
    return sum(jnp.sum(x, axis=0) for x in jax.tree.leaves(products))  # pyright: ignore


def _matvec(A: Array, x: Array) -> Array:
    """A [..., i, j, B] times x [..., j, B], written out: one fused kernel."""
    terms = [A[..., j, :] * x[..., None, j, :] for j in range(x.shape[-2])]
    return functools.reduce(jnp.add, terms)


def times(shape: Arrow, A: Fronts, x: Split) -> Split:
    """A x."""
    core = _matvec(A.core, x.core)
    limbs = []
    for stack, front, part in zip(shape.stacks, A.limbs, x.limbs, strict=True):
        product = _matvec(front, _with_core(stack, part, x.core))
        size = part.shape[1]
        limbs.append(product[:, :size])
        core = _add_to_core(stack, core, product[:, size:])
    return Split(tuple(limbs), core)


def rows_times(shape: Arrow, J: Split, x: Split) -> Array:
    """J x in the order of `row_order`."""
    parts = []
    for stack, rows, part in zip(shape.stacks, J.limbs, x.limbs, strict=True):
        product = _matvec(rows, _with_core(stack, part, x.core))
        parts.append(product.reshape(-1, product.shape[-1]))
    return jnp.concatenate([*parts, _matvec(J.core, x.core)])


def assembled(
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


def solve(shape: Arrow, A: Fronts, b: Split) -> Split:
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
        _substitute(factor, take(x_core, stack.core))
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
