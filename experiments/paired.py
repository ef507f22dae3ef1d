"""What the figures share: policies to measure, paired numbers, rows on disk."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import dcc_jax
from dcc_jax.evaluate import bootstrap
from dcc_jax.evaluate.bootstrap import Interval

if TYPE_CHECKING:
    from dcc_jax.evaluate.report import Report


def parser(description: str, name: str, alpha: Sequence[float]) -> argparse.Namespace:
    """The arguments of a figure that is called `name`."""
    options = argparse.ArgumentParser(description=description.splitlines()[0])
    add = options.add_argument
    add("runs", nargs="*", type=Path, metavar="RUN_DIR", help="one or more seeds")
    add("--alpha", type=float, nargs="+", default=list(alpha), metavar="A")
    add("--episodes", type=int, default=128, help="of each run and level (128)")
    add("--seed", type=int, default=0, help="of the perturbations (0)")
    add("--preset", default="cpu", help="of the training, where there is one (cpu)")
    add("--out", type=Path, default=Path(f"runs/{name}.png"), metavar="FILE.png")
    return options.parse_args()


def policies(options: argparse.Namespace, task: str, folder: Path) -> list[Path]:
    """The runs that were named, or one trained now for all levels of compliance.

    A training that was stopped goes on where it was.
    """
    if options.runs:
        return options.runs
    config = dcc_jax.make_config(task, preset=options.preset)
    env = dataclasses.replace(
        config.env, alpha=min(options.alpha), alpha_max=max(options.alpha)
    )
    config = dataclasses.replace(config, env=env)
    begun = (folder / "config.json").exists()
    return [dcc_jax.train(config, run_dir=folder, resume=begun).run_dir]


def evaluated(options: argparse.Namespace, task: str, folder: Path) -> Report:
    """The episodes of those policies at every level of compliance."""
    return dcc_jax.evaluate(
        policies(options, task, folder),
        episodes=options.episodes,
        alpha=options.alpha,
        seed=options.seed,
        say=print,
    )


def tell(points: list[dict], out: Path) -> None:
    """Prints the points, a line each, and where the figure is."""
    for p in points:
        interval = f"{p['value']:.3f} [{p['low']:.3f}, {p['high']:.3f}]"
        print(f"alpha {p['alpha']:.2f}  {p['name']:17s} {interval}")
    print(out)


def column(rows: list[dict], name: str, **where: object) -> np.ndarray:
    """The values [N] of a metric in the rows that match."""
    return np.array(
        [row[name] for row in rows if all(row[k] == v for k, v in where.items())]
    )


def mean(rows: list[dict], name: str, **where: object) -> Interval:
    """Mean of a metric over episodes, or the share of one that is true or false."""
    values = column(rows, name, **where)
    if name == "fell":
        return bootstrap.share(values)
    return bootstrap.mean(values, bootstrap.draws(len(values)))


def ratio(rows: list[dict], name: str, alpha: float, baseline: float, **where: object):
    """Ratio of the means at two levels of compliance, episodes paired."""
    values = column(rows, name, alpha=alpha, **where)
    others = column(rows, name, alpha=baseline, **where)
    return bootstrap.ratio(values, others, bootstrap.draws(len(values)))


def write(out: Path, rows: list[dict], points: list[dict]) -> None:
    """FILE.csv, a row an episode, and FILE.json, what is drawn, beside the figure.

    Numbers that are undefined become null.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.with_suffix(".csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0] if rows else [])
        table.writeheader()
        table.writerows(rows)
    text = json.dumps(points, indent=1)
    text = re.sub(r"\bNaN\b|-?\bInfinity\b", "null", text)
    out.with_suffix(".json").write_text(text + "\n")
