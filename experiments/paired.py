"""What the figures share: policies to measure, paired numbers, rows on disk.

An arm is a level of compliance, `{"alpha": 0.16, "u_on": True}`. In the control arm of
that level, `u_on` False, the policy observes alpha and nothing is displaced.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import dcc_jax
from dcc_jax.evaluate import bootstrap, compare
from dcc_jax.evaluate.bootstrap import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dcc_jax.env.task import Task
    from dcc_jax.evaluate.report import Report

Row = dict[str, Any]
Arm = dict[str, Any]


def parser(
    description: str, name: str, alpha: Sequence[float]
) -> argparse.ArgumentParser:
    """The arguments of a figure that is called `name`."""
    options = argparse.ArgumentParser(description=description.splitlines()[0])
    add = options.add_argument
    add("runs", nargs="*", type=Path, metavar="RUN_DIR", help="one or more seeds")
    add("--episodes", type=int, default=128, help="of each run and arm (128)")
    add("--preset", default="cpu", help="of the training, where there is one (cpu)")
    options.set_defaults(folder=Path(f"runs/{name}"))
    add_shared(options, name, alpha)
    return options


def add_shared(
    options: argparse.ArgumentParser, name: str, alpha: Sequence[float]
) -> None:
    """The arguments of every comparison of levels."""
    add = options.add_argument
    add("--alpha", type=float, nargs="+", default=list(alpha), metavar="A")
    add(
        "--control",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="each level above 0 also with u off (yes)",
    )
    add("--seed", type=int, default=0, help="of the perturbations (0)")
    add("--out", type=Path, default=Path(f"runs/{name}.png"), metavar="FILE.png")


def policies(options: argparse.Namespace, task: str) -> list[Path]:
    """The runs that were named, or one trained now for all levels of compliance.

    A training that was stopped goes on where it was.
    """
    if options.runs:
        return options.runs
    folder = options.folder
    config = dcc_jax.make_config(task, preset=options.preset)
    env = dataclasses.replace(
        config.env, alpha=min(options.alpha), alpha_max=max(options.alpha)
    )
    config = dataclasses.replace(config, env=env)
    begun = (folder / "config.json").exists()
    return [dcc_jax.train(config, run_dir=folder, resume=begun).run_dir]


def evaluated(
    options: argparse.Namespace, runs: list[Path], task: Task | None = None
) -> Report:
    """The episodes of those policies in every arm."""
    return dcc_jax.evaluate(
        runs,
        episodes=options.episodes,
        alpha=options.alpha,
        seed=options.seed,
        task=task,
        control=options.control,
        say=print,
    )


def arms(levels: Sequence[float], control: bool) -> list[Arm]:
    """All arms; the first is the baseline."""
    found = [{"alpha": level, "u_on": True} for level in levels]
    off = [{"alpha": level, "u_on": False} for level in levels if level > 0.0]
    return found + (off if control else [])


def arms_of(rows: list[Row]) -> list[Arm]:
    """The arms that rows or points are of, in their order."""
    pairs = dict.fromkeys((row["alpha"], row["u_on"]) for row in rows)
    return [{"alpha": alpha, "u_on": u_on} for alpha, u_on in pairs]


def label(arm: Arm) -> str:
    return f"alpha {arm['alpha']:g}{'' if arm['u_on'] else ', u off'}"


def line(arm: Arm, levels: Sequence[float]) -> dict[str, Any]:
    """Colour and dashes: a control arm is its level's, dashed."""
    colour = f"C{list(dict.fromkeys(levels)).index(arm['alpha'])}"
    return {"color": colour, "linestyle": "-" if arm["u_on"] else "--"}


def errorbar(axes: Axes, x: Sequence[Any], points: list[Row], **style: Any) -> None:
    """The points' values with their intervals."""
    value = [p["value"] for p in points]
    bars = (
        [p["value"] - p["low"] for p in points],
        [p["high"] - p["value"] for p in points],
    )
    axes.errorbar(x, value, bars, **({"marker": "o", "capsize": 2} | style))


def tell(points: list[Row], out: Path) -> None:
    """Prints the points, a line each, and where the figure is."""
    for p in points:
        interval = f"{p['value']:.3f} [{p['low']:.3f}, {p['high']:.3f}]"
        print(f"{label(p):18s} {p['name']:22s} {interval}")
    print(out)


def column(rows: list[Row], name: str, **where: object) -> np.ndarray:
    """The values [N] of a metric in the rows that match."""
    return np.array(
        [row[name] for row in rows if all(row[k] == v for k, v in where.items())]
    )


def mean(rows: list[Row], name: str, **where: object) -> Interval:
    """Mean of a metric over episodes, or the share of one that is true or false."""
    values = column(rows, name, **where)
    return compare.mean_or_share(name, values, bootstrap.draws(len(values)))


def ratio(
    rows: list[Row], name: str, arm: Arm, baseline: Arm, **where: object
) -> Interval:
    """Ratio of the means in two arms, episodes paired."""
    values = column(rows, name, **arm, **where)
    others = column(rows, name, **baseline, **where)
    return bootstrap.ratio(values, others, bootstrap.draws(len(values)))


def difference(
    rows: list[Row], name: str, arm: Arm, baseline: Arm, **where: object
) -> Interval:
    """Difference of the means in two arms, episodes paired."""
    values = column(rows, name, **arm, **where)
    others = column(rows, name, **baseline, **where)
    return bootstrap.difference(values, others, bootstrap.draws(len(values)))


def effects(rows: list[Row], name: str, **where: object) -> list[Row]:
    """What each level above the first does to a metric, as differences of the means.

    `with u` and `told alpha, u off` are against the first level; `compliance` is the
    difference of these two, the effect of compliance alone.
    """
    found = []
    for arm in arms_of(rows)[1:]:
        off = arm | {"u_on": False}
        first = arms_of(rows)[0]
        kind = "with u" if arm["u_on"] else "told alpha, u off"
        pairs = [(kind, arm, first)]
        if arm["u_on"] and off in arms_of(rows):
            pairs.append(("compliance", arm, off))
        for kind, one, other in pairs:
            interval = difference(rows, name, one, other, **where)
            found.append(
                {"name": name, "effect": kind, "alpha": arm["alpha"], **where}
                | dataclasses.asdict(interval)
            )
    return found


def tell_effects(points: list[Row]) -> None:
    """Prints what `effects` found, a line each."""
    for p in points:
        interval = f"{p['value']:+.4f} [{p['low']:+.4f}, {p['high']:+.4f}]"
        print(f"alpha {p['alpha']:g} {p['effect']:18s} {p['name']:22s} {interval}")


def write(out: Path, rows: list[Row], points: list[Row]) -> None:
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


def panels(widths: Sequence[float], height: float = 3.8):
    """A figure with panels side by side, of these widths in inches, and its axes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(
        1,
        len(widths),
        figsize=(sum(widths), height),
        gridspec_kw={"width_ratios": list(widths)},
        layout="constrained",
    )
