"""Which entries of a scene's mass matrix and constraint rows can ever be non-zero.

A person is a trunk with limbs: no entry of the mass matrix couples one limb with
another, and a contact between a limb and the world adds none. So M and every
H = M + J^T D J of the contact solver have the shape of an arrow,

    [ limb 1                 x ]
    [          limb 2        x ]
    [                  ...   x ]
    [   x        x      x  core],

and factor without fill-in, limbs of one size side by side (`solver`). The core are the
degrees of freedom above a fork of the tree, and those of whatever has no fork and
touches something: a ball, a plate, a door. Everything here is static: numpy, computed
once a scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

BLOCK = 3
"""Pivots that are eliminated at once; sizes are padded to multiples of it."""


@dataclass(frozen=True, eq=False)
class Stack:
    """G limbs of one size n, each coupled with k of the core's unknowns.

    Indices that stand for padding are one past the end: nv, c or R.
    """

    dofs: np.ndarray  # [G, n] of the scene
    core: np.ndarray  # [G, k] positions in `Arrow.core`
    rows: np.ndarray  # [G, r] constraint rows that touch the limb
    identity: np.ndarray  # [G, n + k, n + k] ones where a padded unknown is its own


@dataclass(frozen=True, eq=False)
class Arrow:
    """The shape of one scene's matrices. Hashable by identity."""

    nv: int
    num_rows: int
    stacks: tuple[Stack, ...]
    core: np.ndarray  # [c] dofs
    core_rows: np.ndarray  # [r] rows that touch no limb
    core_identity: np.ndarray  # [c, c]


def arrow(model: mujoco.MjModel, row_pattern: np.ndarray) -> Arrow:
    """The shape of a scene.

    Args:
        model: the scene's.
        row_pattern: [R, nv] bool, where the rows of J can be non-zero.
    """
    related = _related(model)
    coupled = related | (row_pattern.T.astype(int) @ row_pattern.astype(int) > 0)
    is_core = _is_core(related, coupled)
    limbs = _components(coupled, np.flatnonzero(~is_core))
    core = np.flatnonzero(is_core)
    padded_core = _padded(core, model.nv, _rounded(len(core)))
    in_limb = row_pattern[:, ~is_core].any(axis=1)
    stacks = []
    for size in sorted({_rounded(len(limb)) for limb in limbs}, reverse=True):
        members = [limb for limb in limbs if _rounded(len(limb)) == size]
        stacks.append(_stack(members, size, core, coupled, row_pattern))
    return Arrow(
        nv=model.nv,
        num_rows=len(row_pattern),
        stacks=tuple(stacks),
        core=padded_core,
        core_rows=np.flatnonzero(~in_limb),
        core_identity=np.diag((padded_core == model.nv).astype(float)),
    )


def _stack(
    limbs: list[np.ndarray],
    size: int,
    core: np.ndarray,
    coupled: np.ndarray,
    row_pattern: np.ndarray,
) -> Stack:
    nv = len(coupled)
    touched = [
        np.flatnonzero(coupled[np.ix_(limb, core)].any(axis=0)) for limb in limbs
    ]
    rows = [np.flatnonzero(row_pattern[:, limb].any(axis=1)) for limb in limbs]
    width = max(map(len, touched))
    depth = max(map(len, rows))
    dofs = np.array([_padded(limb, nv, size) for limb in limbs])
    columns = np.array([_padded(t, len(core), width) for t in touched])
    identity = np.zeros((len(limbs), size + width, size + width))
    identity[:, range(size), range(size)] = dofs == nv
    return Stack(
        dofs=dofs,
        core=columns,
        rows=np.array([_padded(r, len(row_pattern), depth) for r in rows]),
        identity=identity,
    )


def _related(model: mujoco.MjModel) -> np.ndarray:
    """[nv, nv] whether one dof is the other's ancestor: the pattern of M."""
    related = np.eye(model.nv, dtype=bool)
    for dof in range(model.nv):
        parent = model.dof_parentid[dof]
        if parent >= 0:
            related[dof] |= related[parent]
    return related | related.T


def _is_core(related: np.ndarray, coupled: np.ndarray) -> np.ndarray:
    """[nv] above a fork, or of a tree that has none and is coupled with another."""
    nv = len(related)
    below = np.tril(related)  # [i, j]: j is i or an ancestor of i
    leaf = below.sum(axis=0) == 1
    leaves_below = below[leaf].sum(axis=0)
    tree = np.array([np.flatnonzero(related[i])[0] for i in range(nv)])
    leaves_of_tree = np.array([leaf[tree == root].sum() for root in tree])
    touches = (coupled & (tree[:, None] != tree)).any(axis=1)
    touches_of_tree = np.array([touches[tree == root].any() for root in tree])
    return (leaves_below > 1) | ((leaves_of_tree == 1) & touches_of_tree)


def _components(coupled: np.ndarray, dofs: np.ndarray) -> list[np.ndarray]:
    """The connected components of `coupled` among `dofs`, each ascending."""
    label = {int(dof): int(dof) for dof in dofs}
    for i in dofs:
        for j in dofs:
            if coupled[i, j] and label[int(i)] != label[int(j)]:
                old, new = label[int(i)], label[int(j)]
                label = {d: new if name == old else name for d, name in label.items()}
    names = sorted(set(label.values()))
    return [np.array([d for d, own in label.items() if own == n]) for n in names]


def _padded(indices: np.ndarray, fill: int, size: int) -> np.ndarray:
    return np.pad(indices, (0, size - len(indices)), constant_values=fill)


def _rounded(size: int) -> int:
    return -(-size // BLOCK) * BLOCK
