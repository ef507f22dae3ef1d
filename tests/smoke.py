"""Smoke-trained policies and players, one a task, shared by all tests of a session."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

import quick
from dcc_jax.config import Config, make_config
from dcc_jax.env.environment import Environment
from dcc_jax.play.player import Player
from dcc_jax.training import loop

ALPHAS = (0.0, 0.16)
UPDATES = 2
BY_COMMAND = {"push": {"task.speed": (2.0, 3.5)}}
"""Tasks whose run the command makes, and parameters that are not the task's own."""

_players: dict[str, Player] = {}


def smoke_config(task: str) -> Config:
    """The smallest run there is, conditioned on alpha."""
    config = make_config(task, "smoke")
    return config.with_(
        {
            "env.alpha": ALPHAS[0],
            "env.alpha_max": ALPHAS[1],
            "train.total_tuples": UPDATES * config.train.tuples_per_update,
            **BY_COMMAND.get(task, {}),
        }
    )


def smoke_run(task: str, factory: pytest.TempPathFactory) -> Path:
    """The run directory of a policy that was trained for two updates."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    run_dir = shared / f"smoke-{task}"
    with (shared / f"{task}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (run_dir / "policy.npz").exists():
            if task in BY_COMMAND:
                said = fresh_python(*command(task), str(run_dir))
                run_dir.with_suffix(".said").write_text(said)
            else:
                loop.train(smoke_config(task), run_dir=run_dir, quiet=True)
    return run_dir


def command(task: str) -> list[str]:
    """Python's arguments that train `smoke_config(task)`, but for the directory."""
    config = smoke_config(task)
    speed = map(str, BY_COMMAND[task]["task.speed"])
    return [
        *("-m", "dcc_jax.train", "--task", task, "--task.speed", *speed),
        *("--preset", "smoke", "--train.total-tuples", str(config.train.total_tuples)),
        *("--env.alpha", str(ALPHAS[0]), "--env.alpha-max", str(ALPHAS[1])),
        "--run-dir",
    ]


def fresh_python(*arguments: str, **variables: str) -> str:
    """What it says on stderr; jax is as an untouched process has it."""
    settings = ("XLA_FLAGS", "TF_CPP_MIN_LOG_LEVEL")
    environ = {k: v for k, v in os.environ.items() if k not in settings}
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**environ, "XLA_FLAGS": quick.flags(environ), **variables},
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stderr


def player(environment: Environment) -> Player:
    """The session's player of an environment like this one: its program is there."""
    same = repr((environment.task, environment.config))
    return _players.setdefault(same, Player(environment))
