"""The directory of a run: begun once, continued with the same configuration."""

from __future__ import annotations

import time
from pathlib import Path

from dcc_jax import config
from dcc_jax.character import asset_path
from dcc_jax.config import Config
from dcc_jax.training import checkpoint

_MAY_CHANGE = ("train.total_tuples", "train.checkpoint_interval")
SWEEP = "sweep.json"
"""Beside the configuration of a sweep: its seeds and levels of compliance."""


class RunError(RuntimeError):
    """A run that began and could not go on."""


def default_run_dir(task: str) -> Path:
    """`runs/<task>-<date>-<time>` in the working directory."""
    return Path("runs") / f"{task}-{time.strftime('%Y%m%d-%H%M%S')}"


def find(name: str | Path) -> Path:
    """The directory of a policy: a run's, or that of one that ships, by path or name.

    Raises:
        ValueError: there is none, or there are the many of a sweep.
    """
    path = Path(name)
    if not path.exists():
        path = _shipped(str(name))
    if (path / SWEEP).exists():
        within = ", ".join(sorted(p.parent.name for p in path.glob("*/policy.npz")))
        raise ValueError(f"{name} is a sweep; its runs are {within or 'not begun'}")
    return path


def check(run_dir: Path, wanted: Config, resume: bool) -> None:
    """Finds out whether a run can begin there, or go on there.

    Raises:
        ValueError: the directory is in use, what it holds is another run, or a policy
            without the checkpoint that it would go on from.
    """
    if resume:
        _check_whole(run_dir)
        _check_same(config.load(run_dir), wanted, run_dir)
        if (run_dir / "policy.npz").exists() and not checkpoint.available(run_dir):
            raise ValueError(
                f"{run_dir} holds a policy and no checkpoint, so it cannot be resumed; "
                f"--train.start-from {run_dir} begins a new run with the policy"
            )
    elif run_dir.exists() and not run_dir.is_dir():
        raise ValueError(f"run_dir {run_dir} is a file")
    elif run_dir.exists() and any(run_dir.iterdir()):
        raise ValueError(
            f"run_dir {run_dir} exists and is not empty; --resume continues a run"
        )


def begin(run_dir: Path, wanted: Config) -> None:
    """Makes the directory, with the configuration in it.

    Raises:
        ValueError: nothing can be written there.
    """
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        checkpoint.write_atomically(
            run_dir / "config.json", config.to_json(wanted).encode()
        )
    except OSError as error:
        raise ValueError(
            f"run_dir {run_dir} cannot be written ({error.strerror}); "
            "--run-dir DIR names another place"
        ) from None


def _shipped(name: str) -> Path:
    """The directory of a policy that ships: `push` and `assets/policies/push` alike."""
    try:
        folder = asset_path("policies")
        known = sorted(entry.name for entry in folder.iterdir())
    except FileNotFoundError:
        folder, known = Path(), []
    if Path(name).name in known and Path(name).parts[:-1] in (
        (),
        ("assets", "policies"),
    ):
        return folder / Path(name).name
    ships = f"; policies that ship: {', '.join(known)}" if known else ""
    raise ValueError(f"{name} is not a run directory{ships}")


def _check_whole(run_dir: Path) -> None:
    whole = run_dir.parent
    if (whole / SWEEP).exists() and checkpoint.available(whole):
        raise ValueError(
            f"{run_dir} is one run of the sweep {run_dir.parent}, and goes on with it"
        )


def _check_same(old: Config, new: Config, run_dir: Path) -> None:
    for name, before, after in config.differences(old, new):
        if name not in _MAY_CHANGE:
            raise ValueError(
                f"{name} is {before} in {run_dir} and cannot become {after}; only "
                f"{' and '.join(_MAY_CHANGE)} may change when a run is resumed"
            )
