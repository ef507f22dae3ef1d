"""Python and the command line are one program."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dcc_jax.training import logs

TUPLES = 2 * 16 * 8  # two updates
COMMAND = (
    *("-m", "dcc_jax.train", "--task", "push", "--task.speed", "1.0", "1.5"),
    *("--preset", "smoke", "--train.total-tuples", str(TUPLES), "--run-dir"),
)
SCRIPT = f"""
import sys
import dcc_jax

config = dcc_jax.make_config("push", preset="smoke")
config = config.with_({{"task.speed": (1.0, 1.5), "train.total_tuples": {TUPLES}}})
dcc_jax.train(config, run_dir=sys.argv[1])
"""


def _run(*arguments: str) -> str:
    """What it says on stderr; jax is as an untouched process has it."""
    settings = ("XLA_FLAGS", "TF_CPP_MIN_LOG_LEVEL")
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={k: v for k, v in os.environ.items() if k not in settings},
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stderr


def _comparable(run_dir: Path) -> list[dict[str, float]]:
    return [
        {name: x for name, x in row.items() if name not in logs.WALL_CLOCK}
        for row in logs.read(run_dir)
    ]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    """The run directory and stderr of the same run, begun either way."""
    folder = tmp_path_factory.mktemp("both")
    paths = {name: folder / name for name in ("command", "python")}
    return {
        "command": (paths["command"], _run(*COMMAND, str(paths["command"]))),
        "python": (paths["python"], _run("-c", SCRIPT, str(paths["python"]))),
    }


def test_run_begun_from_python_is_that_of_the_command_bit_for_bit(both):
    command, python = (path for path, _ in both.values())
    assert _comparable(command) == _comparable(python)
    assert len(_comparable(command)) == 2
    configs = [json.loads((p / "config.json").read_text()) for p in (command, python)]
    assert configs[0] == configs[1]
    assert configs[0]["task"]["speed"] == [1.0, 1.5]
    with np.load(command / "policy.npz") as a, np.load(python / "policy.npz") as b:
        assert a.files == b.files
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])


def test_both_say_once_and_alike_how_jax_is_set_up(both):
    lines = [
        [line for line in said.splitlines() if line.startswith("dcc_jax: ")]
        for _, said in both.values()
    ]
    assert lines[0] == lines[1] and len(lines[0]) == 1
