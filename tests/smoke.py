"""Smoke-trained policies, one a task, shared by the workers of a session."""

from __future__ import annotations

import dataclasses
import fcntl
import os
from pathlib import Path

import pytest

from dcc_jax.config import Config, make_config
from dcc_jax.training import loop

ALPHAS = (0.0, 0.16)


def smoke_config(task: str) -> Config:
    """The smallest run there is, conditioned on alpha."""
    config = make_config(task, "smoke")
    env = dataclasses.replace(config.env, alpha=ALPHAS[0], alpha_max=ALPHAS[1])
    train = dataclasses.replace(
        config.train, total_tuples=2 * config.train.tuples_per_update
    )
    return dataclasses.replace(config, env=env, train=train)


def smoke_run(task: str, factory: pytest.TempPathFactory) -> Path:
    """The run directory of a policy that was trained for two updates."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    run_dir = shared / f"smoke-{task}"
    with (shared / f"{task}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (run_dir / "policy.npz").exists():
            loop.train(smoke_config(task), run_dir=run_dir, quiet=True)
    return run_dir
