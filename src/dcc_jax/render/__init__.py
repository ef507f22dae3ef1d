"""What a trained policy looks like: `python -m dcc_jax.render RUN_DIR`.

This file imports nothing heavy; `film` does the work.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dcc_jax.env.task import Task


def render(
    run_dir: str | Path,
    out: str | Path | None = None,
    *,
    seconds: float = 8.0,
    alpha: float | None = None,
    seed: int = 0,
    strip: str | Path | None = None,
    task: Task | None = None,
) -> None:
    """Films a policy; `dcc_jax.render.film.render` says what the arguments are."""
    from dcc_jax.render import film

    film.render(
        run_dir, out, seconds=seconds, alpha=alpha, seed=seed, strip=strip, task=task
    )
