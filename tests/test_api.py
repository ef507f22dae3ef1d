"""Python and the command line are one program."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

import smoke
from dcc_jax.training import logs

pytestmark = pytest.mark.xdist_group("push")
CHANGES = {
    **smoke.BY_COMMAND["push"],
    "env.alpha": smoke.ALPHAS[0],
    "env.alpha_max": smoke.ALPHAS[1],
    "train.total_tuples": smoke.smoke_config("push").train.total_tuples,
}
TALKATIVE = {"JAX_DEBUG_LOG_MODULES": "jax._src.compiler"}
SCRIPT = f"""
import sys
import dcc_jax

config = dcc_jax.make_config("push", preset="smoke")
config = config.with_({CHANGES})
dcc_jax.train(config, run_dir=sys.argv[1])
"""


def _comparable(run_dir: Path) -> list[dict[str, float]]:
    return [
        {name: x for name, x in row.items() if name not in logs.WALL_CLOCK}
        for row in logs.read(run_dir)
    ]


@pytest.fixture(scope="module")
def both(
    smoke_run: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, str]]:
    """The run directory and stderr of the same run, begun either way."""
    command = smoke_run("push")
    python = tmp_path_factory.mktemp("both") / "python"
    return {
        "command": (command, command.with_suffix(".said").read_text()),
        "python": (python, smoke.fresh_python("-c", SCRIPT, str(python), **TALKATIVE)),
    }


def test_run_begun_from_python_is_that_of_the_command_bit_for_bit(both):
    command, python = (path for path, _ in both.values())
    assert _comparable(command) == _comparable(python)
    assert len(_comparable(command)) == smoke.UPDATES
    configs = [json.loads((p / "config.json").read_text()) for p in (command, python)]
    assert configs[0] == configs[1]
    assert configs[0]["task"]["speed"] == [2.0, 3.5]
    with np.load(command / "policy.npz") as a, np.load(python / "policy.npz") as b:
        assert a.files == b.files
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])


def test_a_second_start_finds_in_the_cache_what_the_first_has_compiled(both):
    if not jax.config.jax_compilation_cache_dir:
        pytest.skip("no compile cache")
    _, said = both["python"]
    for program in ("jit_init", "jit_update"):
        assert f"Persistent compilation cache hit for '{program}'" in said


def test_both_say_once_and_alike_how_jax_is_set_up(both):
    lines = [
        [line for line in said.splitlines() if line.startswith("dcc_jax: ")]
        for _, said in both.values()
    ]
    assert lines[0] == lines[1] and len(lines[0]) == 1
