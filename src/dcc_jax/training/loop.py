"""The training loop: compile, update, log, save, stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import numpy as np

from dcc_jax import runtime, tasks
from dcc_jax.config import Config
from dcc_jax.learn import learner, style
from dcc_jax.learn.rollout import Environment, Incident, Policy
from dcc_jax.learn.state import TrainState
from dcc_jax.training import checkpoint, folder, logs, processes
from dcc_jax.training.folder import RunError, default_run_dir
from dcc_jax.training.start import starting_policy
from dcc_jax.training.stop import StopSignal
from dcc_jax.training.verdict import verdict

_MAX_DUMPS = 20


@dataclass(frozen=True)
class TrainResult:
    """What a run leaves."""

    params: Policy  # the policy with its normaliser, host arrays
    metrics: list[dict[str, float]]  # one entry an update, as in metrics.jsonl
    run_dir: Path
    finished: bool  # False: a signal ended it before all tuples were collected


@dataclass(frozen=True)
class Run:
    """A run that is about to begin: all that can be wrong with its input is checked."""

    config: Config
    run_dir: Path
    environment: Environment
    mesh: jax.sharding.Mesh
    resume: bool
    start: Policy | None  # that it begins with, in place of a warm start


def train(
    config: Config,
    *,
    run_dir: Path | str | None = None,
    resume: bool = False,
    environment: Environment | None = None,
    quiet: bool = False,
) -> TrainResult:
    """Trains a policy, from nothing or from the last checkpoint.

    Args:
        config: of `make_config`.
        run_dir: where everything goes; default `runs/<task>-<time>`.
        resume: continue the run in `run_dir`, bit for bit.
        environment: in place of the task's own.
        quiet: no progress.

    Raises:
        ValueError: something about the arguments is wrong; nothing was written.
        RunError: the run failed; its checkpoints are intact.
    """
    runtime.ensure(quiet=quiet)
    prepared = prepare(config, run_dir, resume, environment)
    return execute(prepared, quiet=quiet)


def prepare(
    wanted: Config,
    run_dir: Path | str | None = None,
    resume: bool = False,
    environment: Environment | None = None,
) -> Run:
    """Checks everything a user can get wrong, and begins the run directory.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
    """
    if run_dir is None:
        if resume:
            raise ValueError("resume needs run_dir: the run to continue")
        run_dir = default_run_dir(wanted.task.name)
    place = Path(run_dir)
    runtime.ensure()
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError("a training is in single precision: unset JAX_ENABLE_X64")
    processes.by_the_first(lambda: folder.check(place, wanted, resume))
    if environment is None:
        environment = make_environment(wanted)
    mesh = learner.make_mesh(wanted.train)
    learner.check_sizes(wanted, mesh.size)
    first = not (resume and checkpoint.available(place))
    start = starting_policy(wanted, environment) if first else None
    if first:
        processes.by_the_first(lambda: folder.begin(place, wanted))
    return Run(wanted, place, environment, mesh, resume, start)


def execute(run: Run, *, quiet: bool = False) -> TrainResult:
    """Trains until all tuples are collected or a signal comes.

    Raises:
        RunError: the disk is full, every checkpoint is damaged, and the like.
    """
    quiet = quiet or not processes.is_first()
    with (
        logs.Progress(run.config.train.total_tuples, quiet) as progress,
        StopSignal() as stop,
    ):
        try:
            return _loop(run, progress, stop)
        except (OSError, checkpoint.CheckpointError) as error:
            raise RunError(f"{error}") from error


def _loop(run: Run, progress: logs.Progress, stop: StopSignal) -> TrainResult:
    train = run.config.train
    state, update = _prepared(run, progress.say)
    measure_style = jax.jit(partial(style.of_running, run.environment))
    done, nan_count = int(state.update), int(state.nan_count)
    log = logs.RunLog(run.run_dir, done) if processes.is_first() else None
    began, saved = time.perf_counter(), done
    while not _all_collected(run, done):
        if processes.anywhere(bool(stop.name)):
            break
        before = time.perf_counter()
        state, report = update(state)
        metrics = _floats(report.metrics)
        done += 1
        now = time.perf_counter()
        metrics = {
            "update": done,
            "tuples": done * train.tuples_per_update,
            "tuples_per_second": train.tuples_per_update / (now - before),
            "seconds": now - began,
            "devices": run.mesh.size,
        } | metrics
        at_checkpoint = done % train.checkpoint_interval == 0
        if at_checkpoint:
            running = processes.on_host(state.running, run.mesh)
            metrics |= _floats(measure_style(running))
        if log is not None:
            log.write(metrics)
        progress.show(metrics)
        if metrics["nan_count"] > nan_count:
            nan_count = int(metrics["nan_count"])
            incident = processes.on_host(report.incident, run.mesh)
            if processes.is_first():
                _dump(run.run_dir, done, incident, progress.say)
        if at_checkpoint:
            _save(run, done, state)
            saved = done
    if saved != done:
        _save(run, done, state)
    if log is not None:
        log.close()
    finished = _all_collected(run, done)
    return _finish(run, done, state, finished, stop, progress.say)


def _prepared(
    run: Run, say: Callable[[str], None]
) -> tuple[TrainState, learner.Update]:
    """The first state, and the update: compiled, where there is one left to make.

    A new state is compiled and made beside the update. Only this thread traces: jax
    shares what it has traced, and where two race for that, the program is another one
    at every start, which no compile cache holds.
    """
    init = learner.make_init(run.environment, run.config, run.mesh, start=run.start)
    key = jax.random.key(run.config.seed)
    if run.resume and checkpoint.available(run.run_dir):
        template = jax.eval_shape(init, key, None)
        state = _restored(run, template, say)
        if _all_collected(run, int(state.update)):
            return state, learner.make_update(run.environment, run.config, run.mesh)
        began = _compiling(run, say)
        compiled = _lowered(run, template).compile()
    else:
        if run.resume:
            say(f"no checkpoint in {run.run_dir}: it begins with the first update")
        began = _compiling(run, say)
        template = jax.eval_shape(init, key, None)
        lowered = init.lower(key, None)  # pyright: ignore[reportFunctionMemberAccess]
        with ThreadPoolExecutor(1) as beside:
            made = beside.submit(lambda: lowered.compile()(key, None))
            compiled = _lowered(run, template).compile()
        state = made.result()
    say(f"compiled in {time.perf_counter() - began:.1f} s")
    return state, compiled


def _compiling(run: Run, say: Callable[[str], None]) -> float:
    """When it began, of `time.perf_counter`."""
    say(f"compiling for {run.mesh.size} {jax.default_backend()} device(s) ...")
    return time.perf_counter()


def _all_collected(run: Run, updates: int) -> bool:
    """Whether so many updates have collected all tuples of the run."""
    train = run.config.train
    return updates * train.tuples_per_update >= train.total_tuples


def _restored(run: Run, template: TrainState, say: Callable[[str], None]) -> TrainState:
    """The state of the last checkpoint that can be read, in a run that goes on."""
    found = checkpoint.restore_latest(run.run_dir, template, say)
    assert found is not None
    processes.by_the_first(lambda: folder.begin(run.run_dir, run.config))
    update, arrays = found
    say(f"resuming {run.run_dir} after update {update}")
    kept = (run.run_dir / "metrics.jsonl").exists()
    rows = logs.read(run.run_dir)[:update] if kept else []
    had = rows[-1].get("devices", run.mesh.size) if rows else run.mesh.size
    if had != run.mesh.size:
        say(
            f"it had {had:.0f} devices and goes on with {run.mesh.size}: from here on "
            "it is another run"
        )
    return processes.to_devices(arrays, learner.state_shardings(run.mesh, arrays))


def _lowered(run: Run, template: TrainState) -> jax.stages.Lowered:
    """The update, traced for a state like the template."""
    update = learner.make_update(run.environment, run.config, run.mesh)
    shardings = learner.state_shardings(run.mesh, template)
    sharded = jax.tree.map(
        lambda x, at: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=at),
        template,
        shardings,
    )
    return update.lower(sharded)  # pyright: ignore[reportFunctionMemberAccess]


def _save(run: Run, done: int, state: TrainState) -> None:
    host = processes.on_host(state, run.mesh)
    if not processes.is_first():
        return
    checkpoint.save(run.run_dir, done, host, run.config.train.keep_checkpoints)
    checkpoint.save_policy(run.run_dir, _policy(host))


def _floats(metrics: dict[str, jax.Array]) -> dict[str, float]:
    return {name: float(value) for name, value in jax.device_get(metrics).items()}


def _policy(state: TrainState) -> Policy:
    return Policy(params=state.averaged, normalizer=state.obs_normalizer)


def _finish(
    run: Run,
    done: int,
    state: TrainState,
    finished: bool,
    stop: StopSignal,
    say: Callable[[str], None],
) -> TrainResult:
    if not finished:
        by = stop.name or "another process"
        when = f"after update {done}; saved" if done else "before the first update"
        say(f"stopped by {by} {when}, continue with --resume --run-dir {run.run_dir}")
    else:
        say(f"finished after update {done}; watch it: dcc-jax view {run.run_dir}")
    metrics = logs.read(run.run_dir)
    if said := verdict(metrics):
        say(said)
    return TrainResult(
        params=_policy(processes.on_host(state, run.mesh)),
        metrics=metrics,
        run_dir=run.run_dir,
        finished=finished,
    )


def _dump(
    run_dir: Path, done: int, incident: Incident, say: Callable[[str], None]
) -> None:
    """Keeps the state and action from which an environment broke."""
    folder = run_dir / "nan"
    folder.mkdir(exist_ok=True)
    if len(list(folder.iterdir())) >= _MAX_DUMPS:
        return
    broken = int(np.argmax(incident.happened))
    one = jax.tree.map(lambda x: x[broken], incident)
    path = folder / f"update-{done:09d}.npz"
    np.savez(path, **checkpoint.to_arrays(one))  # pyright: ignore[reportArgumentType]
    say(f"an environment broke in update {done} and was reset; see {path}")


def make_environment(wanted: Config) -> Environment:
    """The environment of a configuration's task.

    Raises:
        ValueError: clips that are missing or damaged.
    """
    return tasks.make_environment(wanted.task, wanted.env)
