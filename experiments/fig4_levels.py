"""Fig. 4: contact force and torque when obstacles hit, over levels of compliance.

The policies of `push` meet the same balls at every level. Force and torque are ratios
to the first level, episodes paired; bars are 95 % intervals over the episodes of all
runs, thin lines single runs. Two more panels say what the ratios do not: where joints
leave their ranges, and how many characters fall. Beside the figure: FILE.csv, a row an
episode, and FILE.json, what is drawn.

    python experiments/fig4_levels.py [RUN_DIR...] [--alpha 0 0.04 ...] [--out FILE.png]

Several runs, trained with different seeds, are pooled. Without one a policy is trained
first, into `runs/fig4_levels`.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import paired

from dcc_jax import runtime

LEVELS = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28)
RATIOS = {
    "contact/peak": "contact force, peak (ratio)",
    "contact/torque": "torque during contact, RMS (ratio)",
}
MEANS = {
    "range": "farthest joint beyond its range (rad)",
    "fell": "episodes that end by a fall",
}


def measured(rows: list[dict], levels: list[float]) -> list[dict]:
    """Every number drawn: metric, level, run (None: all), value and interval."""
    points = []
    for run in (None, *dict.fromkeys(row["run"] for row in rows)):
        where = {} if run is None else {"run": run}
        for level in levels:
            here = {"run": run, "alpha": level}
            for name in RATIOS:
                found = paired.ratio(rows, name, level, levels[0], **where)
                points.append({"name": name, **here, **asdict(found)})
            for name in MEANS:
                found = paired.mean(rows, name, alpha=level, **where)
                points.append({"name": name, **here, **asdict(found)})
    return points


def draw(points: list[dict], out: Path) -> None:
    """A panel a metric."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = RATIOS | MEANS
    figure, axes = plt.subplots(1, len(panels), figsize=(4.2 * len(panels), 3.8))
    for place, (name, title) in zip(axes, panels.items(), strict=True):
        lines = [p for p in points if p["name"] == name]
        for run in dict.fromkeys(p["run"] for p in lines):
            line = [p for p in lines if p["run"] == run]
            levels, values = ([p[k] for p in line] for k in ("alpha", "value"))
            if run is not None:
                place.plot(levels, values, color="0.75", lw=0.8, zorder=1)
                continue
            bars = (
                [p["value"] - p["low"] for p in line],
                [p["high"] - p["value"] for p in line],
            )
            place.errorbar(levels, values, bars, marker="o", capsize=2)
        if name in RATIOS:
            place.axhline(1.0, color="0.5", lw=0.8)
        place.set(xlabel="level of compliance alpha", title=title)
        place.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def main() -> None:
    options = paired.parser(__doc__, "fig4_levels", LEVELS)
    runtime.ensure()
    report = paired.evaluated(options, "push", Path("runs/fig4_levels"))
    points = measured(report.rows, options.alpha)
    paired.write(options.out, report.rows, points)
    draw(points, options.out)
    paired.tell([p for p in points if p["run"] is None], options.out)


if __name__ == "__main__":
    main()
