"""`dcc-jax curves RUN_DIR...`: how training went, as one picture."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from dcc_jax import command
from dcc_jax.training import logs
from dcc_jax.training.verdict import verdict

PROGRAM = "dcc_jax.curves"
PANELS = {
    "reward": ("reward/total", "reward/r_q", "reward/r_p", "reward/r_task"),
    "control steps of an episode": ("episode/length",),
    "share of episodes that fall": ("episode/fall_rate",),
    "discriminator: share judged right": ("disc/accuracy_real", "disc/accuracy_fake"),
    "distance to the clips (m)": ("style/nearest", "style/frechet", "style/floor"),
    "torque (RMS, N m)": ("env/torque_rms",),
    "KL divergence, mean over the steps of an update": ("ppo/kl",),
    "tuples per second": ("tuples_per_second",),
}
_POINTS = 200  # of a line, at most: equally many neighbouring updates are averaged


def draw(run_dirs: Sequence[Path], out: Path) -> None:
    """Writes a figure of the metrics of one run, or of several in one panel each.

    Args:
        run_dirs: of runs with at least one update.
        out: a file that matplotlib can write.

    Raises:
        ValueError: a directory holds no metrics.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    runs = {run_dir.name: _metrics(run_dir) for run_dir in run_dirs}
    figure, grid = plt.subplots(2, 4, figsize=(16, 7), layout="constrained")
    for axes, (title, names) in zip(grid.flat, PANELS.items(), strict=True):
        for run, rows in runs.items():
            for name in names:
                label = name.rpartition("/")[2]
                _line(axes, rows, name, label if len(runs) == 1 else f"{run} {label}")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("M tuples")
        axes.set_visible(bool(axes.lines))
        if axes.lines and (len(names) > 1 or len(runs) > 1):
            axes.legend(fontsize=7)
    said = {name: verdict(rows) for name, rows in runs.items()}
    lines = (": ".join(filter(None, pair)) for pair in said.items())
    figure.suptitle("\n".join(textwrap.fill(line, 140) for line in lines))
    figure.savefig(out, dpi=100)
    plt.close(figure)


def _line(axes, rows: list[dict[str, float]], name: str, label: str) -> None:
    import numpy as np

    known = [row for row in rows if row.get(name) is not None]
    if not known:
        return
    size = -(-len(known) // _POINTS)
    parts = [known[i : i + size] for i in range(0, len(known), size)]
    tuples = [np.mean([row["tuples"] for row in part]) / 1e6 for part in parts]
    values = [np.mean([row[name] for row in part]) for part in parts]
    axes.plot(tuples, values, label=label)


def _metrics(run_dir: Path) -> list[dict[str, float]]:
    try:
        rows = logs.read(run_dir)
    except OSError:
        rows = []
    if not rows:
        raise ValueError(f"{run_dir} holds no metrics.jsonl with an update in it")
    return rows


@dataclass(frozen=True)
class Options:
    """Draws how training went: reward, falls, style, speed and more over tuples.

    Exit status: 0 done; 2 a bad argument; 1 a failure."""

    run_dir: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="RUN_DIR [RUN_DIR ...]", help_behavior_hint="(required)"),
    ]
    """Directories of training runs; several are drawn over each other."""

    out: Annotated[
        Path | None,
        arg(metavar="FILE.png", help_behavior_hint="(default: RUN_DIR/curves.png)"),
    ] = None
    """The picture."""

    def __post_init__(self) -> None:
        if not self.run_dir:
            raise ValueError("missing: RUN_DIR")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(PROGRAM, argv, partial(command.parse, PROGRAM, Options), _draw)


def _draw(options: Options) -> command.Work:
    out = options.out or options.run_dir[0] / "curves.png"
    draw(options.run_dir, out)
    return lambda: print(out)


if __name__ == "__main__":
    command.leave(main())
