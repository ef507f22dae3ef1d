"""Many runs: seeds x levels of compliance, vmapped as one program, or each a job.

Every run has a directory of its own within that of the sweep, which evaluation, video
and curves take like any other; the checkpoints are of all runs together.
Letters: R runs.
"""

from __future__ import annotations

import csv
import dataclasses
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dcc_jax import runtime
from dcc_jax.config import Config
from dcc_jax.learn import learner
from dcc_jax.learn.rollout import Environment, Policy
from dcc_jax.learn.state import TrainState
from dcc_jax.learn.update import chunk_size
from dcc_jax.training import checkpoint, folder, jobs, logs, plan
from dcc_jax.training.loop import make_environment
from dcc_jax.training.start import starting_policy
from dcc_jax.training.stop import StopSignal


@dataclass(frozen=True)
class SweepResult:
    """One table of all runs."""

    rows: list[dict[str, Any]]  # seed, alpha, update and every metric
    policies: dict[plan.Setting, Policy]  # by (seed, alpha), host arrays
    run_dir: Path
    run_dirs: dict[plan.Setting, Path]  # of every run, within it
    finished: bool  # False: a signal ended it before all tuples were collected

    def last(self) -> list[dict[str, Any]]:
        """The rows of the last update, one a run."""
        update = max((row["update"] for row in self.rows), default=0)
        return [row for row in self.rows if row["update"] == update]

    def to_csv(self, path: Path | str) -> None:
        """Writes the table."""
        with Path(path).open("w", newline="") as file:
            names = list(dict.fromkeys(name for row in self.rows for name in row))
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(self.rows)


@dataclass(frozen=True)
class _Sweep:
    """A sweep that is about to begin: its input is checked."""

    config: Config  # as it is run, of every run
    run_dirs: dict[plan.Setting, Path]
    run_dir: Path
    environment: Environment
    mesh: jax.sharding.Mesh
    resume: bool
    start: Policy | None  # that every run begins with

    @property
    def settings(self) -> list[plan.Setting]:
        return list(self.run_dirs)


def sweep(
    config: Config,
    seeds: int | Iterable[int] = range(5),
    alpha: float | Iterable[float] | None = None,
    *,
    run_dir: Path | str | None = None,
    resume: bool = False,
    environment: Environment | None = None,
    executor: jobs.Executor | None = None,
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
        executor: starts every run as a job of its own, such as a
            `concurrent.futures.ProcessPoolExecutor` or submitit's; None: all are one
            program of this process.
        quiet: no progress.

    Raises:
        ValueError: no seeds or no alphas, or something about the configuration;
            nothing was written.
        RunError: the sweep failed; its checkpoints are intact.
    """
    runtime.ensure(quiet=quiet)
    settings = plan.settings_of(config, seeds, alpha)
    if jax.process_count() > 1:
        raise ValueError("a sweep is of one process; executor=... starts others")
    if executor is not None:
        return _as_jobs(executor, config, settings, run_dir, resume, environment, quiet)
    prepared = _prepare(config, settings, run_dir, resume, environment)
    total = config.train.total_tuples
    with logs.Progress(total, quiet) as progress, StopSignal() as stop:
        try:
            return _loop(prepared, progress, stop)
        except (OSError, checkpoint.CheckpointError) as error:
            raise folder.RunError(f"{error}") from error


def _as_jobs(
    executor: jobs.Executor,
    config: Config,
    settings: list[plan.Setting],
    run_dir: Path | str | None,
    resume: bool,
    environment: Environment | None,
    quiet: bool,
) -> SweepResult:
    run_dir = plan.check(config, settings, run_dir, resume)
    if environment is None:
        make_environment(config)  # says now what each of them would
    runs = plan.begin(config, settings, run_dir)
    configs = {path: plan.config_of(config, *setting) for setting, path in runs.items()}
    with logs.Progress(config.train.total_tuples, quiet) as progress:
        progress.say(f"training {len(settings)} runs, each a job of its own")
        finished = jobs.run(executor, configs, environment, progress.say)
    result = SweepResult(
        rows=plan.rows(runs),
        policies={
            setting: checkpoint.load_policy(path) for setting, path in runs.items()
        },
        run_dir=run_dir,
        run_dirs=runs,
        finished=finished,
    )
    result.to_csv(run_dir / "table.csv")
    return result


def _prepare(
    wanted: Config,
    settings: list[plan.Setting],
    run_dir: Path | str | None,
    resume: bool,
    environment: Environment | None,
) -> _Sweep:
    run_dir = plan.check(wanted, settings, run_dir, resume)
    environment = make_environment(wanted) if environment is None else environment
    mesh = learner.make_mesh(wanted.train)
    config = _chunked(wanted, mesh.size, len(settings))
    learner.check_sizes(config, mesh.size)
    first = not (resume and checkpoint.available(run_dir))
    start = starting_policy(wanted, environment) if first else None
    runs = plan.begin(wanted, settings, run_dir)
    return _Sweep(config, runs, run_dir, environment, mesh, resume, start)


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
    init = learner.make_init(
        sweep.environment, sweep.config, sweep.mesh, runs=True, start=sweep.start
    )
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


def _policies(sweep: _Sweep, host: TrainState) -> dict[plan.Setting, Policy]:
    of_all = Policy(params=host.averaged, normalizer=host.obs_normalizer)
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
    train = sweep.config.train
    finished = done * train.tuples_per_update >= train.total_tuples
    result = SweepResult(
        rows=plan.rows(sweep.run_dirs),
        policies=_policies(sweep, jax.device_get(state)),
        run_dir=sweep.run_dir,
        run_dirs=sweep.run_dirs,
        finished=finished,
    )
    result.to_csv(sweep.run_dir / "table.csv")
    if not finished:
        say(f"stopped by {stop.name} after update {done}; saved, resume continues it")
    else:
        say(f"finished after update {done}: {sweep.run_dir}")
    return result


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
