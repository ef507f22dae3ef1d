"""Many runs as one program: seeds x levels of compliance, vmapped.

Letters: R runs.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.config import Config
from dcc_jax.learn import learner
from dcc_jax.learn.rollout import Environment, Policy
from dcc_jax.learn.update import chunk_size
from dcc_jax.training import logs
from dcc_jax.training.loop import make_environment


@dataclass(frozen=True)
class SweepResult:
    """One table of all runs."""

    rows: list[dict[str, float]]  # seed, alpha, update and every metric
    policies: dict[tuple[int, float | None], Policy]  # by (seed, alpha), host arrays

    def last(self) -> list[dict[str, float]]:
        """The rows of the last update, one a run."""
        update = max((row["update"] for row in self.rows), default=0)
        return [row for row in self.rows if row["update"] == update]

    def to_csv(self, path: Path | str) -> None:
        """Writes the table."""
        with Path(path).open("w", newline="") as file:
            names = list(self.rows[0]) if self.rows else []
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(self.rows)


def sweep(
    config: Config,
    seeds: Iterable[int] = range(5),
    alpha: Iterable[float] | None = None,
    *,
    environment: Environment | None = None,
    quiet: bool = False,
) -> SweepResult:
    """Trains every combination of seed and alpha side by side.

    A run does not notice the others: it draws what it would have drawn alone.

    Args:
        config: of every run; its seed is replaced.
        seeds: of the runs.
        alpha: levels of compliance (Eq. 6); None: as the environment's own
            configuration says.
        environment: in place of the task's own.
        quiet: no progress.

    Raises:
        ValueError: no seeds or no alphas, or something about the configuration.
    """
    runs = list(itertools.product(seeds, [None] if alpha is None else alpha))
    if not runs:
        raise ValueError("sweep needs at least one seed and one alpha")
    environment = make_environment(config) if environment is None else environment
    mesh = learner.make_mesh(config.train)
    config = _chunked(config, mesh.size, len(runs))
    keys = jnp.stack([jax.random.key(seed) for seed, _ in runs])
    levels = None if alpha is None else jnp.array([level for _, level in runs])
    state = learner.make_init(environment, config, mesh, runs=True)(keys, levels)
    update = learner.make_update(environment, config, mesh, runs=True)
    rows: list[dict[str, float]] = []
    with logs.Progress(config.train.total_tuples, quiet) as progress:
        progress.say(f"training {len(runs)} runs as one program")
        for done in range(1, _updates(config) + 1):
            state, report = update(state)
            metrics = jax.device_get(report.metrics)
            rows += _rows(runs, done, config, metrics)
    host = jax.device_get(state)
    policies = {
        run: jax.tree.map(
            lambda x, i=i: x[i],
            Policy(params=host.agent.policy.params, normalizer=host.obs_normalizer),
        )
        for i, run in enumerate(runs)
    }
    return SweepResult(rows=rows, policies=policies)


def _rows(
    runs: list[tuple[int, float | None]],
    done: int,
    config: Config,
    metrics: dict[str, np.ndarray],
) -> list[dict[str, Any]]:
    tuples = done * config.train.tuples_per_update
    return [
        {"seed": seed, "alpha": level, "update": done, "tuples": tuples}
        | {name: float(values[i]) for name, values in metrics.items()}
        for i, (seed, level) in enumerate(runs)
    ]


def _updates(config: Config) -> int:
    return -(-config.train.total_tuples // config.train.tuples_per_update)


def _chunked(config: Config, devices: int, runs: int) -> Config:
    """Shares the cache of a core among the runs: R times fewer environments at once."""
    local = config.train.num_envs // devices
    chunk = chunk_size(config.train, local)
    if chunk is None:
        return config
    wanted = max(1, chunk // runs)
    fitting = max(n for n in range(1, local + 1) if local % n == 0 and n <= wanted)
    train = dataclasses.replace(config.train, chunk_size=fitting)
    return dataclasses.replace(config, train=train)
