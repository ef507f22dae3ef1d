"""Fig. 5: feet and energy on the trampoline, with and without compliance.

Left how high the lowest sole is, in the middle the character's total energy, both over
the time since a bounce; bands are 95 % intervals. Right how low the feet go while the
compliance controller acts and what energy those contacts leave, of all episodes. Dashed
is the control arm: the policy observes alpha, and nothing is displaced. Every arm meets
the same bounces. Beside the figure: FILE.csv, a row an episode, and FILE.json, what is
drawn.

    python experiments/fig5_trampoline.py [RUN_DIR...] [--alpha 0 0.16] [--out FILE.png]

Several runs, trained with different seeds, are pooled. Without one a policy is trained
first, into `runs/fig5_trampoline`.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import paired

from dcc_jax import command, runtime

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dcc_jax.evaluate.report import Report

LEVELS = (0.0, 0.16)
CURVES = {
    "foot_height": "lowest sole (m)",
    "energy": "kinetic and potential energy (J)",
}
BARS = {
    "contact/foot_low": "lowest sole in a contact (m)",
    "contact/energy": "energy gained in a contact (J)",
}


def pooled(report: Report, name: str, arm: dict) -> dict:
    """A curve over all runs: times, means, half widths of the intervals.

    Runs differ by more than their episodes: three or more are averaged as they are.
    """
    curves = [
        np.array(curves[name])
        for condition, curves in zip(report.conditions, report.curves, strict=True)
        if arm.items() <= asdict(condition).items()
    ]
    shortest = min(curve.shape[1] for curve in curves)
    time, mean, half = np.stack([c[:, :shortest] for c in curves], axis=1)
    between = 1.96 * mean.std(axis=0, ddof=len(mean) > 1) / np.sqrt(len(mean))
    within = np.sqrt(np.sum(half**2, axis=0)) / len(mean)
    return {
        "name": name,
        **arm,
        "seconds": time[0].tolist(),
        "mean": mean.mean(axis=0).tolist(),
        "half": (between if len(mean) > 2 else within).tolist(),
    }


def measured(report: Report) -> list[dict]:
    """Everything drawn: curves by arm, then means by arm."""
    arms = paired.arms_of(report.rows)
    return [pooled(report, name, arm) for name in CURVES for arm in arms] + [
        {"name": name, **arm, **asdict(paired.mean(report.rows, name, **arm))}
        for name in BARS
        for arm in arms
    ]


def draw(points: list[dict], out: Path) -> None:
    """Two curves and two bars."""
    widths = [5.0] * len(CURVES) + [3.0] * len(BARS)
    figure, axes = paired.panels(widths)
    for place, (name, title) in zip(axes, (CURVES | BARS).items(), strict=True):
        here = [p for p in points if p["name"] == name]
        (_draw_curves if name in CURVES else _draw_bars)(place, here)
        place.set_title(title, fontsize=10)
        place.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(out, dpi=120)


def _draw_curves(axes: Axes, points: list[dict]) -> None:
    for p in points:
        style = paired.line(p, [q["alpha"] for q in points])
        time, mean, half = (np.array(p[k]) for k in ("seconds", "mean", "half"))
        axes.plot(time, mean, label=paired.label(p), **style)
        band = {"color": style["color"], "alpha": 0.2, "lw": 0.0}
        axes.fill_between(time, mean - half, mean + half, **band)
    axes.set_xlabel("s since the bounce")


def _draw_bars(axes: Axes, points: list[dict]) -> None:
    for p in points:
        colour = paired.line(p, [q["alpha"] for q in points])["color"]
        face = {} if p["u_on"] else {"markerfacecolor": "white"}
        name = paired.label(p).replace(", ", "\n")
        paired.errorbar(axes, [name], [p], color=colour, **face)
    axes.margins(x=0.3)


def main() -> None:
    options = paired.parser(__doc__ or "", "fig5_trampoline", LEVELS).parse_args()
    runtime.ensure()
    report = paired.evaluated(options, paired.policies(options, "trampoline"))
    points = measured(report)
    effects = [p for name in BARS for p in paired.effects(report.rows, name)]
    paired.write(options.out, report.rows, points + effects)
    draw(points, options.out)
    paired.tell_effects(effects)
    paired.tell([p for p in points if p["name"] in BARS], options.out)


if __name__ == "__main__":
    command.script(main)
