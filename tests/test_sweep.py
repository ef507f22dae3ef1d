"""Seeds and levels of compliance as one program, on the toy."""

from __future__ import annotations

import csv
import dataclasses
import importlib

import jax
import numpy as np
import pytest

from dcc_jax.learn import learner
from toy import Toy
from toy_learner import compiled_toy
from toy_run import toy_config

# The package shows the function of that name; these tests want the module.
sweeping = importlib.import_module("dcc_jax.training.sweep")

SEEDS, ALPHAS, UPDATES = (3, 4), (0.0, 0.8), 30


@pytest.fixture(scope="module")
def result() -> sweeping.SweepResult:
    # vmap turns the `cond` of the auto-reset into a select over its operands, which
    # the checker takes for a second use of the keys.
    with jax.debug_key_reuse(False):
        return sweeping.sweep(
            toy_config(UPDATES), SEEDS, ALPHAS, environment=Toy(), quiet=True
        )


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
    config = toy_config(1)
    config = dataclasses.replace(
        config, train=dataclasses.replace(config.train, num_envs=256, chunk_size=128)
    )
    chunked = sweeping._chunked(config, devices=2, runs=4)
    assert chunked.train.chunk_size == 32
    learner.check_sizes(chunked, devices=2)
