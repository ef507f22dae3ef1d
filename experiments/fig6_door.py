"""Fig. 6: the forces at the knob against the width of the door, by level of compliance.

Left what of the force is orthogonal to the knob's path, in the middle what is along it,
right how many doors are open in the end. The policies know a door of 1.0 m alone. Every
door and every level meet the same episodes; bars are 95 % intervals over them. Beside
the figure: FILE.csv, a row an episode, and FILE.json, what is drawn.

    python experiments/fig6_door.py [RUN_DIR...] [--alpha 0 0.16] [--out FILE.png]

Several runs, trained with different seeds, are pooled. Without one a policy is trained
first, into `runs/fig6_door`.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import re
from pathlib import Path

import dcc_jax
from dcc_jax import runtime

TRAINED = Path("runs/fig6_door")
OPEN = "task/open/final"
CURVES = {
    "task/orthogonal_force/mean": "force orthogonal to the knob's path (N)",
    "task/parallel_force/mean": "force along the knob's path (N)",
    OPEN: "doors open in the end",
}


def train(preset: str) -> Path:
    """A policy for all levels of compliance, resumed where it was left."""
    config = dcc_jax.make_config("door", preset=preset)
    env = dataclasses.replace(config.env, alpha=0.0, alpha_max=0.16)
    config = dataclasses.replace(config, env=env)
    begun = (TRAINED / "config.json").exists()
    return dcc_jax.train(config, run_dir=TRAINED, resume=begun).run_dir


def measure(runs: list[Path], options: argparse.Namespace) -> list[dict]:
    """A row an episode: width, run, alpha, episode and what was measured."""
    from dcc_jax.tasks.door import Door

    rows = []
    for width in options.widths:
        report = dcc_jax.evaluate(
            runs,
            episodes=options.episodes,
            alpha=options.alpha,
            seed=options.seed,
            task=Door(width=width),
        )
        rows += [{"width": width, **row} for row in report.rows]
        print(f"width {width:.2f} m: {len(report.rows)} episodes")
    return rows


def curves(rows: list[dict]) -> list[dict]:
    """Mean and interval of every number by width and level of compliance.

    Paired with the first level: `ratio` is that of the means, episode by episode.
    """
    import numpy as np

    from dcc_jax.evaluate import bootstrap

    levels = list(dict.fromkeys(row["alpha"] for row in rows))
    found = []
    for width in dict.fromkeys(row["width"] for row in rows):
        for name in CURVES:
            values = {
                level: np.array(
                    [
                        r[name]
                        for r in rows
                        if (r["width"], r["alpha"]) == (width, level)
                    ]
                )
                for level in levels
            }
            resamples = bootstrap.draws(len(values[levels[0]]))
            for level in levels:
                if name == OPEN:
                    point = bootstrap.share(values[level])
                else:
                    point = bootstrap.mean(values[level], resamples)
                ratio = bootstrap.ratio(values[level], values[levels[0]], resamples)
                found.append(
                    {"width": width, "alpha": level, "name": name}
                    | dataclasses.asdict(point)
                    | {"ratio": dataclasses.astuple(ratio)}
                )
    return found


def as_json(points: list[dict]) -> str:
    """Numbers that are undefined, such as the ratio of two zeros, become null."""
    text = json.dumps(points, indent=1)
    return re.sub(r"\bNaN\b|-?\bInfinity\b", "null", text)


def draw(points: list[dict], out: Path) -> None:
    """The three panels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(CURVES), figsize=(12.5, 3.8))
    levels = list(dict.fromkeys(point["alpha"] for point in points))
    for axes, (name, title) in zip(panels, CURVES.items(), strict=True):
        for level in levels:
            line = [p for p in points if (p["name"], p["alpha"]) == (name, level)]
            value = [p["value"] for p in line]
            bars = (
                [p["value"] - p["low"] for p in line],
                [p["high"] - p["value"] for p in line],
            )
            widths = [p["width"] for p in line]
            axes.errorbar(
                widths, value, bars, marker="o", capsize=2, label=f"alpha = {level:g}"
            )
        axes.set(xlabel="width of the door (m)", title=title)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        if name == OPEN:
            axes.set_ylim(0.0, 1.05)
        axes.grid(alpha=0.3)
    panels[0].legend()
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN_DIR")
    parser.add_argument("--alpha", type=float, nargs="+", default=[0.0, 0.16])
    parser.add_argument(
        "--widths", type=float, nargs="+", default=[1.0 + 0.1 * i for i in range(8)]
    )
    parser.add_argument(
        "--episodes", type=int, default=64, help="of each door and level"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--preset", default="cpu", help="of the training, if there is one"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/fig6_door.png"))
    options = parser.parse_args()
    runtime.ensure()
    runs = options.runs or [train(options.preset)]
    rows = measure(runs, options)
    points = curves(rows)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.with_suffix(".csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)
    options.out.with_suffix(".json").write_text(as_json(points) + "\n")
    draw(points, options.out)
    print(options.out)


if __name__ == "__main__":
    main()
