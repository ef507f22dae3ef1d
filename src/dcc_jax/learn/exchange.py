"""What the devices of a mesh axis tell each other.

On a CPU, XLA (jax 0.9.2) starts an operation as soon as its operands are there, a
collective also while a loop that contains collectives still runs beside it. It tells
collectives apart by a number that jax gives equally to all of them, so when one device
is ahead, the sum of one place meets that of another: wrong numbers, or a crash. So in
one program **every collective outside loops must depend on the one before, loops with
collectives included**; tests/learn/test_exchange.py holds the programs to it.

Letters: D devices.
"""

from __future__ import annotations

from typing import TypeVar

import jax
from jax.flatten_util import ravel_pytree

Tree = TypeVar("Tree")


def mean_tree(tree: Tree, axis_name: str) -> Tree:
    """The mean over all devices of every leaf [...], in a single exchange."""
    flat, restore = ravel_pytree(tree)
    return restore(jax.lax.pmean(flat, axis_name))


def all_gather_tree(tree: Tree, axis_name: str) -> Tree:
    """The values of all devices, leaves [...] -> [D, ...], in a single exchange.

    Args:
        tree: of this device. Integers travel as float32: exact below 2^24.
        axis_name: mesh axis of the devices.
    """
    flat, restore = ravel_pytree(tree)
    return jax.vmap(restore)(jax.lax.all_gather(flat, axis_name))
