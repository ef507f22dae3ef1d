"""One training over several processes, on one machine or many.

Every process runs the same program on its own devices; the first one alone writes. With
a single process nothing here does anything.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding, PartitionSpec

T = TypeVar("T")


def is_first() -> bool:
    """Whether this process writes and speaks."""
    return jax.process_index() == 0


def by_the_first(work: Callable[[], object]) -> None:
    """Lets the first process do something, which the others wait for.

    Raises:
        ValueError: in the others, where it failed in the first.
    """
    if jax.process_count() == 1:
        work()
        return
    failed: Exception | None = None
    if is_first():
        try:
            work()
        except Exception as error:
            failed = error
    if anywhere(failed is not None):
        raise failed or ValueError("process 0 could not begin; it says why")


def anywhere(flag: bool) -> bool:
    """Whether a flag is up in any process."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def on_host(tree: T, mesh: jax.sharding.Mesh) -> T:
    """All of a tree of arrays in every process, as host arrays."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.device_get(jax.jit(lambda x: x, out_shardings=everywhere)(tree))


def to_devices(tree: T, shardings: T) -> T:
    """Host arrays, equal in every process, on the devices of all.

    Args:
        tree: the arrays.
        shardings: of every leaf.
    """
    if jax.process_count() == 1:
        return jax.device_put(tree, shardings)
    return jax.jit(lambda x: x, out_shardings=shardings)(tree)
