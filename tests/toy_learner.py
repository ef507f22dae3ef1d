"""The toy's learner, compiled once for all tests."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import pytest

from dcc_jax.learn import learner
from toy import Toy, ToyConfig


@dataclass(frozen=True)
class Compiled:
    """The toy's learner; tracing its update a second time is an error."""

    config: ToyConfig
    mesh: jax.sharding.Mesh
    init: Any
    update: Any
    traces: Callable[[], int]


@functools.cache
def compiled_toy() -> Compiled:
    """Compiles it on the first call."""
    environment, config = Toy(), ToyConfig()
    mesh = learner.make_mesh(config.train)
    traced = []
    plain = learner.update_state

    def noted(*args: Any) -> Any:
        traced.append(args)
        return plain(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner, "update_state", chex.assert_max_traces(noted, n=1))
        update = learner.make_update(environment, config, mesh)
        init = learner.make_init(environment, config, mesh)
        # Traced while the counter is in place.
        update(init(jax.random.key(0), None))
    return Compiled(config, mesh, init, update, lambda: len(traced))
