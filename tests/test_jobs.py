"""Sweeps whose runs are jobs of an executor."""

from __future__ import annotations

import importlib
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from dcc_jax.play import runs
from dcc_jax.training import folder, jobs, logs, loop
from toy import Toy
from toy_run import INTERVAL, toy_config

# The package shows the function of that name; these tests want the module.
sweeping = importlib.import_module("dcc_jax.training.sweep")

SEEDS, ALPHA, UPDATES = (3, 4), 0.3, 20


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPoolExecutor]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        yield pool


@pytest.fixture(scope="module")
def halfway(pool: ProcessPoolExecutor, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return swept(pool, tmp_path_factory.mktemp("jobs") / "sweep", INTERVAL)


def swept(executor: Any, run_dir: Path, updates: int, **options: Any) -> Any:
    return sweeping.sweep(
        toy_config(updates),
        SEEDS,
        ALPHA,
        run_dir=run_dir,
        environment=Toy(),
        executor=executor,
        **options,
    )


@dataclass
class AtOnce:
    """Runs a job when it is submitted, as some queues do in their tests."""

    fails: str = ""  # the name of a run

    def submit(self, job: Any, config: Any, run_dir: Path, environment: Any) -> Future:
        future: Future = Future()
        try:
            if run_dir.name == self.fails:
                raise OSError("no space left\non device")
            future.set_result(job(config, run_dir, environment))
        except Exception as error:
            future.set_exception(error)
        return future


def test_a_run_of_a_job_is_the_run_alone(pool, halfway, tmp_path):
    """The sweep is resumed on the way."""
    result = swept(pool, halfway.run_dir, UPDATES, resume=True)
    assert result.finished
    for seed in SEEDS:
        config = toy_config(UPDATES).with_({"seed": seed, "env.alpha": ALPHA})
        alone = loop.train(
            config, run_dir=tmp_path / f"{seed}", environment=Toy(), quiet=True
        )
        policy = result.policies[seed, ALPHA]
        jax.tree.map(np.testing.assert_array_equal, policy, alone.params)
        rows = [row for row in result.rows if row["seed"] == seed]
        assert [row["update"] for row in rows] == list(range(1, UPDATES + 1))
        for row, other in zip(rows, alone.metrics, strict=True):
            for name in set(other) - set(logs.WALL_CLOCK):
                assert row[name] == other[name], name


def test_its_table_and_its_policies_are_those_of_any_sweep(halfway):
    assert (halfway.run_dir / "table.csv").exists()
    assert {row["seed"] for row in halfway.last()} == set(SEEDS)
    with pytest.raises(ValueError, match=r"is a sweep; its runs are seed3-alpha0\.3, "):
        runs.find_run(halfway.run_dir)


def test_such_a_run_can_go_on_alone(tmp_path):
    result = swept(AtOnce(), tmp_path / "sweep", INTERVAL)
    run_dir = result.run_dirs[SEEDS[0], ALPHA]
    config = toy_config(INTERVAL + 2).with_({"seed": SEEDS[0], "env.alpha": ALPHA})
    alone = loop.train(
        config, run_dir=run_dir, resume=True, environment=Toy(), quiet=True
    )
    assert len(alone.metrics) == INTERVAL + 2


def test_one_that_fails_is_named_and_the_others_go_on(tmp_path, capsys):
    failing = AtOnce(fails="seed3-alpha0.3")
    with pytest.raises(
        folder.RunError,
        match=r"^1 of 2 runs failed: seed3-alpha0.3 \(no space left on device\)$",
    ):
        swept(failing, tmp_path / "sweep", INTERVAL)
    said = capsys.readouterr().err
    assert "1 of 2: failed (no space left on device):" in said
    assert "2 of 2: finished" in said
    result = swept(AtOnce(), tmp_path / "sweep", INTERVAL, resume=True)
    assert result.finished and len(result.last()) == 2


def test_jobs_that_wait_are_called_off_when_the_sweep_is_interrupted(
    tmp_path, monkeypatch
):
    futures: list[Future] = []

    class Waiting:
        def submit(self, *_: Any) -> Future:
            futures.append(Future())
            return futures[-1]

    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.time, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        swept(Waiting(), tmp_path / "sweep", INTERVAL)
    assert len(futures) == 2 and all(future.cancelled() for future in futures)
