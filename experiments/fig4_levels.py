"""Fig. 4: contact force and torque when obstacles hit, over levels of compliance.

The policies of `push` meet the same balls at every level. Force and torque are ratios
to the first level, episodes paired; bars are 95 % intervals over the episodes of all
runs, thin lines single runs. Dashed is the control arm: the policy observes alpha, and
nothing is displaced. Two more panels say what the ratios do not: where joints leave
their ranges, and how many characters fall. Beside the figure: FILE.csv, a row an
episode, and FILE.json, what is drawn.

    python experiments/fig4_levels.py [RUN_DIR...] [--alpha 0 0.04 ...] [--out FILE.png]

Several runs, trained with different seeds, are pooled. Without one a policy is trained
first, into `runs/fig4_levels`.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import paired

from dcc_jax import command, runtime

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVELS = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28)
RATIOS = {
    "contact/peak": "contact force, peak (ratio)",
    "contact/torque": "torque during contact, RMS (ratio)",
}
MEANS = {
    "range": "farthest joint beyond its range (rad)",
    "fell": "episodes that end by a fall",
}


def measured(rows: list[dict]) -> list[dict]:
    """Every number drawn: metric, arm, run (None: all), value and interval."""
    points = []
    first, *_ = arms = paired.arms_of(rows)
    for run in (None, *dict.fromkeys(row["run"] for row in rows)):
        where = {} if run is None else {"run": run}
        for arm in arms:
            found = {
                name: paired.ratio(rows, name, arm, first, **where) for name in RATIOS
            }
            found |= {name: paired.mean(rows, name, **arm, **where) for name in MEANS}
            points += [
                {"name": name, "run": run, **arm, **asdict(interval)}
                for name, interval in found.items()
            ]
    return points


def draw(points: list[dict], out: Path) -> None:
    """A panel a metric."""
    titles = RATIOS | MEANS
    figure, axes = paired.panels([4.2] * len(titles))
    for place, (name, title) in zip(axes, titles.items(), strict=True):
        _draw_metric(place, [p for p in points if p["name"] == name])
        if name in RATIOS:
            place.axhline(1.0, color="0.5", lw=0.8)
        place.set(xlabel="level of compliance alpha", title=title)
        place.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(out, dpi=120)


def _draw_metric(axes: Axes, points: list[dict]) -> None:
    """Over alpha: all runs with u on and off, then the single runs."""
    first = points[0]["alpha"]
    for u_on, name, style in ((True, "u on", "-"), (False, "u off", "--")):
        # At the first level the two arms are one.
        here = [p for p in points if p["u_on"] == u_on or p["alpha"] == first]
        pooled = [p for p in here if p["run"] is None]
        if len(pooled) > 1:
            levels = [p["alpha"] for p in pooled]
            paired.errorbar(axes, levels, pooled, linestyle=style, label=name)
    for run in dict.fromkeys(p["run"] for p in points if p["run"] is not None):
        line = [p for p in points if p["run"] == run and p["u_on"]]
        levels, values = ([p[k] for p in line] for k in ("alpha", "value"))
        axes.plot(levels, values, color="0.75", lw=0.8, zorder=1)


def main() -> None:
    options = paired.parser(__doc__ or "", "fig4_levels", LEVELS).parse_args()
    runtime.ensure()
    report = paired.evaluated(options, paired.policies(options, "push"))
    points = measured(report.rows)
    paired.write(options.out, report.rows, points)
    draw(points, options.out)
    paired.tell([p for p in points if p["run"] is None], options.out)


if __name__ == "__main__":
    command.script(main)
