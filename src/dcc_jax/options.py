"""The arguments of `dcc-jax train`, generated from the configuration's dataclasses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from dcc_jax import command, config, tasks
from dcc_jax.config import Config
from dcc_jax.tasks import TASKS
from dcc_jax.training.loop import default_run_dir

PROGRAM = "dcc_jax.train"
_HELP = ("-h", "--help")


@dataclass(frozen=True)
class Options:
    """Trains a compliant policy (Lee, Chang, Lee, SIGGRAPH 2022).

    Every option shows its default for the chosen --task and --preset, and where it
    comes from.

    Exit status: 0 done, or stopped by a signal and saved; 2 a bad argument; 1 a run
    that failed."""

    config: Annotated[Config, arg(name="")]

    task: Annotated[
        str,
        arg(
            metavar="NAME",
            help=f"What the character does: {', '.join(TASKS)}, or package.module:Name "
            "of a task of your own (docs/tasks.md). Its own parameters are the options "
            "--task.* below.",
            help_behavior_hint=lambda name: f"(required; shown: {name})",
        ),
    ]

    run_dir: Path
    """Where checkpoints, metrics.jsonl, config.json, policy.npz and TensorBoard go."""

    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in --run-dir from its last readable checkpoint."""


@dataclass(frozen=True)
class _First:
    """What decides on the defaults of everything else."""

    task: str | None = None
    preset: str | None = None
    run_dir: Path | None = None
    resume: FlagCreatePairsOff[bool] = False


def parse(argv: Sequence[str]) -> Options:
    """Reads the command line.

    Raises:
        ValueError: one line that says what is wrong with it.
        SystemExit: `--help` was printed.
    """
    first, others = command.parse_known(PROGRAM, _First, argv)
    if first.resume:
        if first.run_dir is None:
            raise ValueError("--resume needs --run-dir, the run to continue")
        base = _retasked(config.load(first.run_dir), first.task)
    elif first.task is None and not set(_HELP) & set(others):
        raise ValueError("--task is required; see --help")
    else:
        base = config.make_config(first.task or "trampoline", first.preset or "cpu")
    default = Options(
        config=base,
        task=tasks.task_name(base.task),
        run_dir=default_run_dir(base.task.name),
    )
    return command.parse(PROGRAM, Options, argv, default)


def _retasked(base: Config, task: str | None) -> Config:
    """The run to continue, with the task that is asked for where that is another."""
    if task in (None, base.task.name, tasks.task_name(base.task)):
        return base
    return base.with_({"task": task})
