"""What a trained policy does, measured: `python -m dcc_jax.evaluate RUN_DIR`.

This file imports nothing heavy; `report` does the work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dcc_jax.env.task import Task
    from dcc_jax.evaluate.report import Report


def evaluate(
    run_dir: str | Path | Sequence[str | Path],
    *,
    episodes: int = 256,
    alpha: Sequence[float] | None = None,
    seed: int = 0,
    seconds: float | None = None,
    task: Task | None = None,
    control: bool = True,
    say: Callable[[str], None] = lambda _: None,
) -> Report:
    """Measures policies; `dcc_jax.evaluate.report.evaluate` says what they are."""
    from dcc_jax.evaluate import report

    return report.evaluate(
        run_dir,
        episodes=episodes,
        alpha=alpha,
        seed=seed,
        seconds=seconds,
        task=task,
        control=control,
        say=say,
    )
