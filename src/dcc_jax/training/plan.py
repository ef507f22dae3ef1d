"""Which runs a sweep has, and where they are: seeds x levels of compliance."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dcc_jax.config import Config
from dcc_jax.training import checkpoint, folder, logs

Setting = tuple[int, float | None]  # seed and alpha of a run


def settings_of(
    config: Config, seeds: int | Iterable[int], alpha: float | Iterable[float] | None
) -> list[Setting]:
    """Every combination of seed and alpha, or of seed and the configuration's alpha.

    Raises:
        ValueError: none, one twice, or a number out of its range.
    """
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


def check(
    wanted: Config, settings: list[Setting], run_dir: Path | str | None, resume: bool
) -> Path:
    """The directory in which the sweep begins or goes on.

    Raises:
        ValueError: it is in use, or what it holds is another sweep.
    """
    if run_dir is None:
        if resume:
            raise ValueError("resume needs run_dir: the sweep to continue")
        run_dir = folder.default_run_dir(f"sweep-{wanted.task.name}")
    run_dir = Path(run_dir)
    if resume:
        _check_same(run_dir, settings)
    folder.check(run_dir, wanted, resume)
    return run_dir


def begin(
    wanted: Config, settings: list[Setting], run_dir: Path
) -> dict[Setting, Path]:
    """Makes the directory of every run, with its configuration in it."""
    folder.begin(run_dir, wanted)
    written = json.dumps(settings).encode()
    checkpoint.write_atomically(run_dir / folder.SWEEP, written)
    runs = {setting: run_dir / _name(*setting) for setting in settings}
    for setting, path in runs.items():
        folder.begin(path, config_of(wanted, *setting))
    return runs


def config_of(wanted: Config, seed: int, level: float | None) -> Config:
    """Of one run."""
    of_level = {} if level is None else {"env.alpha": level, "env.alpha_max": None}
    return wanted.with_({"seed": seed, **of_level})


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


def rows(run_dirs: dict[Setting, Path]) -> list[dict[str, Any]]:
    """The lines of every run's metrics.jsonl, update by update."""
    rows = [
        {"seed": seed, "alpha": level} | row
        for (seed, level), path in run_dirs.items()
        for row in logs.read(path)
    ]
    return sorted(rows, key=lambda row: row["update"])
