"""One compiled learner of the toy serves all its tests."""

from __future__ import annotations

from typing import Any

import jax
import pytest

from toy_learner import Compiled, compiled_toy


@pytest.fixture(scope="session")
def compiled() -> Compiled:
    return compiled_toy()


@pytest.fixture
def first_state(compiled: Compiled) -> Any:
    return compiled.init(jax.random.key(0), None)
