"""Many runs as one program: seeds x levels of compliance, vmapped.

Every run has a directory of its own within that of the sweep, which evaluation, video
and curves take like any other; the checkpoints are of all runs together.
Letters: R runs.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import runtime
from dcc_jax.config import Config
from dcc_jax.learn import learner
from dcc_jax.learn.rollout import Environment, Policy
from dcc_jax.learn.state import TrainState
from dcc_jax.learn.update import chunk_size
from dcc_jax.training import checkpoint, folder, logs
from dcc_jax.training.loop import make_environment
from dcc_jax.training.stop import StopSignal

Setting = tuple[int, float | None]  # seed and alpha of a run


@dataclass(frozen=True)
class SweepResult:
    """One table of all runs."""

    rows: list[dict[str, Any]]  # seed, alpha, update and every metric
    policies: dict[Setting, Policy]  # by (seed, alpha), host arrays
    run_dir: Path
    run_dirs: dict[Setting, Path]  # of every run, within it
    finished: bool  # False: a signal ended it before all tuples were collected

    def last(self) -> list[dict[str, Any]]:
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


@dataclass(frozen=True)
class _Sweep:
    """A sweep that is about to begin: its input is checked."""

    config: Config  # as it is run, of every run
    settings: list[Setting]
    run_dir: Path
    environment: Environment
    mesh: jax.sharding.Mesh
    resume: bool

    @property
    def run_dirs(self) -> dict[Setting, Path]:
        return {setting: self.run_dir / _name(*setting) for setting in self.settings}


def sweep(
    config: Config,
    seeds: int | Iterable[int] = range(5),
    alpha: float | Iterable[float] | None = None,
    *,
    run_dir: Path | str | None = None,
    resume: bool = False,
    environment: Environment | None = None,
    quiet: bool = False,
) -> SweepResult:
    """Trains every combination of seed and alpha side by side.

    A run does not notice the others: it draws what it would have drawn alone.

    Args:
        config: of every run; its seed is replaced.
        seeds: of the runs, or one.
        alpha: levels of compliance (Eq. (6)), or one; None: as the environment's own
            configuration says.
        run_dir: where everything goes; default `runs/sweep-<task>-<time>`.
        resume: continue the sweep in `run_dir`, bit for bit.
        environment: in place of the task's own.
        quiet: no progress.

    Raises:
        ValueError: no seeds or no alphas, or something about the configuration;
            nothing was written.
        RunError: the sweep failed; its checkpoints are intact.
    """
    runtime.ensure(quiet=quiet)
    settings = _settings(config, seeds, alpha)
    prepared = _prepare(config, settings, run_dir, resume, environment)
    total = config.train.total_tuples
    with logs.Progress(total, quiet) as progress, StopSignal() as stop:
        try:
            return _loop(prepared, progress, stop)
        except (OSError, checkpoint.CheckpointError) as error:
            raise folder.RunError(f"{error}") from error


def _settings(
    config: Config, seeds: int | Iterable[int], alpha: float | Iterable[float] | None
) -> list[Setting]:
    chosen = [seeds] if isinstance(seeds, int | np.integer) else list(seeds)
    levels = [alpha] if alpha is None or isinstance(alpha, float | int) else list(alpha)
    runs: list[Setting] = [
        (int(seed), None if level is None else float(level))
        for seed, level in itertools.product(chosen, levels)
    ]
    if not runs:
        raise ValueError("sweep needs at least one seed and one alpha")
    if len({_name(*run) for run in runs}) < len(runs):
        raise ValueError(
            f"seeds and alpha must be different numbers, got {chosen} and {levels}"
        )
    for seed, level in runs:
        if not 0 <= seed < 2**32:
            raise ValueError(f"seeds must be between 0 and 2^32 - 1, got {seed}")
        if level is not None:
            config.env.compliance.check_alpha(level)
    return runs


def _prepare(
    wanted: Config,
    settings: list[Setting],
    run_dir: Path | str | None,
    resume: bool,
    environment: Environment | None,
) -> _Sweep:
    if run_dir is None:
        if resume:
            raise ValueError("resume needs run_dir: the sweep to continue")
        run_dir = folder.default_run_dir(f"sweep-{wanted.task.name}")
    run_dir = Path(run_dir)
    if resume:
        _check_same(run_dir, settings)
    folder.check(run_dir, wanted, resume)
    environment = make_environment(wanted) if environment is None else environment
    mesh = learner.make_mesh(wanted.train)
    config = _chunked(wanted, mesh.size, len(settings))
    learner.check_sizes(config, mesh.size)
    folder.begin(run_dir, wanted)
    written = json.dumps(settings).encode()
    checkpoint.write_atomically(run_dir / folder.SWEEP, written)
    prepared = _Sweep(config, settings, run_dir, environment, mesh, resume)
    for (seed, level), path in prepared.run_dirs.items():
        of_level = {} if level is None else {"env.alpha": level, "env.alpha_max": None}
        folder.begin(path, wanted.with_({"seed": seed, **of_level}))
    return prepared


def _check_same(run_dir: Path, settings: list[Setting]) -> None:
    try:
        written = json.loads((run_dir / folder.SWEEP).read_text())
        old = [(seed, level) for seed, level in written]
    except (OSError, ValueError, TypeError):
        raise ValueError(f"{run_dir} holds no sweep to continue") from None
    if old != settings:
        raise ValueError(
            f"the runs in {run_dir} are {_told(old)} and cannot become "
            f"{_told(settings)}"
        )


def _told(settings: list[Setting]) -> str:
    return ", ".join(_name(*setting) for setting in settings)


def _name(seed: int, level: float | None) -> str:
    """Of a run's directory."""
    return f"seed{seed}" if level is None else f"seed{seed}-alpha{level:g}"


def _loop(sweep: _Sweep, progress: logs.Progress, stop: StopSignal) -> SweepResult:
    train = sweep.config.train
    progress.say(
        f"training {len(sweep.settings)} runs as one program on {sweep.mesh.size} "
        "device(s); the first update compiles, numbers are means over the runs"
    )
    done, state = _first_state(sweep, progress.say)
    update = learner.make_update(sweep.environment, sweep.config, sweep.mesh, runs=True)
    files = [logs.RunLog(path, done) for path in sweep.run_dirs.values()]
    began, saved = time.perf_counter(), done
    while done * train.tuples_per_update < train.total_tuples and not stop.name:
        before = time.perf_counter()
        state, report = update(state)
        metrics = jax.device_get(report.metrics)
        done += 1
        now = time.perf_counter()
        clock = {
            "update": done,
            "tuples": done * train.tuples_per_update,
            "tuples_per_second": train.tuples_per_update / (now - before),
            "seconds": now - began,
        }
        for i, file in enumerate(files):
            file.write(clock | {name: float(x[i]) for name, x in metrics.items()})
        progress.show(clock | {name: float(x.mean()) for name, x in metrics.items()})
        if done % train.checkpoint_interval == 0:
            _save(sweep, done, state)
            saved = done
    if saved != done:
        _save(sweep, done, state)
    for file in files:
        file.close()
    return _finish(sweep, done, state, stop, progress.say)


def _first_state(sweep: _Sweep, say: Callable[[str], None]) -> tuple[int, TrainState]:
    """Updates done and the state after them, from the last checkpoint or the seeds."""
    keys = jnp.stack([jax.random.key(seed) for seed, _ in sweep.settings])
    levels = [level for _, level in sweep.settings]
    alpha = None if levels[0] is None else jnp.array(levels)
    init = learner.make_init(sweep.environment, sweep.config, sweep.mesh, runs=True)
    if sweep.resume:
        template = jax.eval_shape(init, keys, alpha)
        found = checkpoint.restore_latest(sweep.run_dir, template, say)
        if found is not None:
            update, arrays = found
            say(f"resuming {sweep.run_dir} after update {update}")
            shardings = learner.state_shardings(sweep.mesh, arrays, runs=True)
            return update, jax.device_put(arrays, shardings)
    return 0, init(keys, alpha)


def _save(sweep: _Sweep, done: int, state: TrainState) -> None:
    host = jax.device_get(state)
    checkpoint.save(sweep.run_dir, done, host, sweep.config.train.keep_checkpoints)
    policies = _policies(sweep, host)
    for setting, path in sweep.run_dirs.items():
        checkpoint.save_policy(path, policies[setting])


def _policies(sweep: _Sweep, host: TrainState) -> dict[Setting, Policy]:
    of_all = Policy(params=host.agent.policy.params, normalizer=host.obs_normalizer)
    return {
        setting: jax.tree.map(lambda x, i=i: x[i], of_all)
        for i, setting in enumerate(sweep.settings)
    }


def _finish(
    sweep: _Sweep,
    done: int,
    state: TrainState,
    stop: StopSignal,
    say: Callable[[str], None],
) -> SweepResult:
    result = SweepResult(
        rows=_rows(sweep),
        policies=_policies(sweep, jax.device_get(state)),
        run_dir=sweep.run_dir,
        run_dirs=sweep.run_dirs,
        finished=not stop.name,
    )
    result.to_csv(sweep.run_dir / "table.csv")
    if stop.name:
        say(f"stopped by {stop.name} after update {done}; saved, resume continues it")
    else:
        say(f"finished after update {done}: {sweep.run_dir}")
    return result


def _rows(sweep: _Sweep) -> list[dict[str, Any]]:
    """The lines of every run's metrics.jsonl, update by update."""
    logged = [logs.read(path) for path in sweep.run_dirs.values()]
    return [
        {"seed": seed, "alpha": level} | row
        for of_update in zip(*logged, strict=True)
        for (seed, level), row in zip(sweep.settings, of_update, strict=True)
    ]


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
