"""The policies that ship fit the environments of today."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.character import asset_path
from dcc_jax.play import runs

SHIPPED = sorted(entry.name for entry in asset_path("policies").iterdir())


def test_push_ships():
    assert "push" in SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_policy_is_found_by_name_and_acts(name):
    run = runs.find_run(name)
    environment = runs.make_environment(run)
    obs = jax.jit(environment.reset)(jax.random.key(0)).obs
    action = run.policy.mean(obs)
    assert action.shape == (environment.action_size,)
    # Radians about the mean pose: less than a turn, more than nothing.
    assert 1e-3 < np.abs(action[:36]).max() < np.pi
    assert jnp.isfinite(action).all()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_policy_is_small(name):
    files = list(asset_path("policies").joinpath(name).iterdir())
    assert {file.name for file in files} == {"config.json", "policy.npz"}
    assert sum(file.stat().st_size for file in files) < 2_000_000
