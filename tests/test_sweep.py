"""Seeds and levels of compliance as one program, on the toy."""

from __future__ import annotations

import csv
import importlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from dcc_jax import config
from dcc_jax.learn import learner
from dcc_jax.play import runs
from dcc_jax.training import logs, loop, plan
from dcc_jax.training.sweep import SweepResult
from toy import Toy
from toy_learner import compiled_toy
from toy_run import INTERVAL, toy_config

# The package shows the function of that name; these tests want the module.
sweeping = importlib.import_module("dcc_jax.training.sweep")

SEEDS, ALPHAS, UPDATES = (3, 4), (0.0, 0.8), 30


def _sweep(run_dir: Path, updates: int, **options: Any) -> SweepResult:
    # vmap turns the `cond` of the auto-reset into a select over its operands, which
    # the checker takes for a second use of the keys.
    with jax.debug_key_reuse(False):
        return sweeping.sweep(
            toy_config(updates),
            SEEDS,
            ALPHAS,
            run_dir=run_dir,
            environment=Toy(),
            **options,
        )


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> SweepResult:
    return _sweep(tmp_path_factory.mktemp("sweep") / "whole", UPDATES, quiet=True)


def _comparable(result: SweepResult) -> list[dict[str, Any]]:
    """The rows without what tells of the machine."""
    return [
        {name: x for name, x in row.items() if name not in logs.WALL_CLOCK}
        for row in result.rows
    ]


def test_sweep_stopped_and_resumed_is_the_same_sweep(result, tmp_path, capsys):
    half = _sweep(tmp_path / "run", INTERVAL)
    assert _comparable(half) == _comparable(result)[: len(half.rows)]
    resumed = _sweep(tmp_path / "run", UPDATES, resume=True)
    said = capsys.readouterr().err
    for part in (f"resuming {resumed.run_dir} after update {INTERVAL}", "M tuples"):
        assert part in said, said.splitlines()
    assert _comparable(resumed) == _comparable(result)
    for setting, policy in result.policies.items():
        jax.tree.map(np.testing.assert_array_equal, policy, resumed.policies[setting])


def test_every_run_of_a_sweep_is_a_run_directory(result):
    assert {path.name for path in result.run_dirs.values()} == {
        *("seed3-alpha0", "seed3-alpha0.8", "seed4-alpha0", "seed4-alpha0.8")
    }
    assert config.load(result.run_dir) == toy_config(UPDATES)
    for (seed, alpha), path in result.run_dirs.items():
        run = runs.find_run(path)
        assert run.config.seed == seed and run.alphas == (alpha, alpha)
        policy = result.policies[seed, alpha]
        jax.tree.map(np.testing.assert_array_equal, run.policy, policy)
        assert len(logs.read(path)) == UPDATES
    table = (result.run_dir / "table.csv").read_text().splitlines()
    assert len(table) == 1 + len(result.rows)


def test_whole_sweep_is_no_policy_but_names_those_it_has(result):
    with pytest.raises(ValueError, match="is a sweep; its runs are seed3-alpha0, "):
        runs.find_run(result.run_dir)


def test_run_of_a_sweep_is_not_resumed_alone(result):
    with pytest.raises(ValueError, match="is one run of the sweep"):
        loop.train(
            toy_config(UPDATES),
            run_dir=result.run_dirs[SEEDS[0], 0.0],
            resume=True,
            environment=Toy(),
        )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seeds": (3, 5)}, "are seed3-alpha0, .* and cannot become seed3-alpha0, "),
        ({"alpha": 0.3}, "cannot become seed3-alpha0.3, seed4-alpha0.3"),
        ({"config": {"ppo.clip": 0.05}}, "ppo.clip is 0.2 in .* and cannot become"),
        ({"resume": False}, "exists and is not empty"),
        ({"run_dir": None}, "resume needs run_dir: the sweep to continue"),
        ({"run_dir": "elsewhere"}, "elsewhere holds no sweep to continue"),
    ],
)
def test_sweep_that_cannot_go_on_is_one_line(result, changes, said):
    arguments = {
        "seeds": SEEDS,
        "alpha": ALPHAS,
        "run_dir": result.run_dir,
        "resume": True,
        **changes,
        "config": toy_config(UPDATES).with_(changes.get("config", {})),
    }
    with pytest.raises(ValueError, match=said):
        sweeping.sweep(**arguments, environment=Toy())


def test_one_seed_and_one_alpha_need_no_sequence():
    assert plan.settings_of(toy_config(1), 3, 0.16) == [(3, 0.16)]
    assert plan.settings_of(toy_config(1), range(2), None) == [(0, None), (1, None)]


@pytest.mark.parametrize(
    ("seeds", "alpha", "said"),
    [
        ((1, 1), None, "must be different numbers"),
        (1, (0.1, 0.1), "must be different numbers"),
        (-1, None, r"seeds must be between 0 and 2\^32 - 1, got -1"),
        (1, 1.5, r"alpha must be in \[0, 0.9\], got 1.5"),
    ],
)
def test_runs_that_make_no_sense_are_named(seeds, alpha, said):
    with pytest.raises(ValueError, match=said):
        plan.settings_of(toy_config(1), seeds, alpha)


def test_table_has_a_row_for_every_run_and_update(result):
    runs = {(row["seed"], row["alpha"]) for row in result.rows}
    assert runs == {(s, a) for s in SEEDS for a in ALPHAS}
    assert len(result.rows) == len(runs) * UPDATES
    assert {row["update"] for row in result.last()} == {UPDATES}
    assert len(result.last()) == len(runs)


def test_alpha_reaches_the_environment_of_its_run_alone(result):
    for (_, alpha), policy in result.policies.items():
        moments = policy.normalizer
        # The toy observes alpha last, and shifts home by it along x.
        np.testing.assert_allclose(moments.mean[2], alpha, atol=1e-5)
        at_home = policy.mean(np.array([alpha, 0.0, alpha], np.float32))
        left = policy.mean(np.array([alpha - 0.7, 0.0, alpha], np.float32))
        assert float(left[0]) > float(at_home[0])


def test_run_of_a_sweep_is_the_run_it_would_have_been_alone(result):
    compiled = compiled_toy()
    state = compiled.init(jax.random.key(SEEDS[0]), None)
    _, report = compiled.update(state)
    alone = {name: float(value) for name, value in report.metrics.items()}
    within = next(
        row for row in result.rows if (row["seed"], row["alpha"]) == (SEEDS[0], 0.0)
    )
    for name in ("reward/r_p", "env/distance", "episode/ended"):
        np.testing.assert_allclose(within[name], alone[name], rtol=1e-3)


def test_csv_holds_the_table(result, tmp_path):
    result.to_csv(tmp_path / "table.csv")
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.rows)
    np.testing.assert_allclose(
        [float(row["reward/total"]) for row in rows],
        [row["reward/total"] for row in result.rows],
    )


def test_no_runs_are_refused():
    with pytest.raises(ValueError, match="at least one seed and one alpha"):
        sweeping.sweep(toy_config(1), [], [0.1], environment=Toy())


def test_runs_share_the_cache_of_a_core():
    made = toy_config(1).with_({"train.num_envs": 256, "train.chunk_size": 128})
    chunked = sweeping._chunked(made, devices=2, runs=4)
    assert chunked.train.chunk_size == 32
    learner.check_sizes(chunked, devices=2)
