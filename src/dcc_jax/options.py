"""The command line of the trainer, generated from the configuration's dataclasses."""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NoReturn

import tyro

from dcc_jax import config, tasks
from dcc_jax.config import Config
from dcc_jax.training.loop import default_run_dir

PROGRAM = "dcc_jax.train"
_DESCRIPTION = """Trains a compliant policy (Lee, Chang, Lee, SIGGRAPH 2022).

Every option shows its default for the chosen --task and --preset, and where it comes
from. Exit status: 0 done, or stopped by a signal and saved; 2 a bad argument; 1 a run
that failed."""


@dataclass(frozen=True)
class Options:
    """What the command line says."""

    config: Annotated[Config, tyro.conf.arg(name="")]

    run_dir: Path
    """Where checkpoints, metrics.jsonl, config.json, policy.npz and TensorBoard go."""

    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --run-dir from its last readable checkpoint."""


def parse(argv: Sequence[str]) -> Options:
    """Reads the command line.

    Raises:
        ValueError: one line that says what is wrong with it.
        SystemExit: `--help` was printed.
    """
    first = _first_look(argv)
    if first.resume:
        if first.run_dir is None:
            raise ValueError("--resume needs --run-dir, the run to continue")
        base = _retasked(config.load(Path(first.run_dir)), first.task)
    elif first.task is None and not first.help:
        raise ValueError("--task is required; see --help")
    else:
        base = config.make_config(first.task or "trampoline", first.preset or "cpu")
    return _full_look(_without_task(argv), base)


def _retasked(base: Config, task: str | None) -> Config:
    """The run to continue, with the task that is asked for where that is another."""
    if task in (None, base.task.name, tasks.task_name(base.task)):
        return base
    return base.with_({"task": task})


def _without_task(argv: Sequence[str]) -> list[str]:
    """`--task NAME` has chosen the section; what is left of it are its parameters."""
    parser = _Raising(add_help=False, allow_abbrev=False)
    parser.add_argument("--task")
    return parser.parse_known_args(argv)[1]


def _first_look(argv: Sequence[str]) -> argparse.Namespace:
    """What decides on the defaults of everything else."""
    parser = _Raising(add_help=False, allow_abbrev=False)
    parser.add_argument("--task")
    parser.add_argument("--preset")
    parser.add_argument("--run-dir", "--run_dir", dest="run_dir")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("-h", "--help", action="store_true")
    return parser.parse_known_args(argv)[0]


def _full_look(argv: Sequence[str], base: Config) -> Options:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Options,
                prog=PROGRAM,
                description=_DESCRIPTION,
                args=list(argv),
                default=Options(config=base, run_dir=default_run_dir(base.task.name)),
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(_one_line(said.getvalue())) from None


def _one_line(box: str) -> str:
    """The sentence in the box that tyro draws around what is wrong."""
    lines = [text for line in box.splitlines() if (text := line.strip(" │"))]
    rules = [i for i, t in enumerate(lines) if t[0] in "╭╰─" or not t.strip("-")]
    body = lines[rules[0] + 1 : rules[1]] if len(rules) > 1 else lines
    return " ".join(body) + "; see --help"


class _Raising(argparse.ArgumentParser):
    """Raises where argparse prints and exits."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)
