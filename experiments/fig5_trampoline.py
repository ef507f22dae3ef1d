"""Fig. 5: feet and energy on the trampoline, with and without compliance.

Left how high the lowest sole is, in the middle the character's total energy, both over
the time since a bounce; bands are 95 % intervals. Right how low the feet go while the
controller listens and what energy those contacts leave, of all episodes. Every level
meets the same bounces. Beside the figure: FILE.csv, a row an episode, and FILE.json,
what is drawn.

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

from dcc_jax import runtime

if TYPE_CHECKING:
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


def pooled(report: Report, name: str, level: float) -> dict:
    """A curve over all runs: times, means, half widths of the intervals.

    Runs differ by more than their episodes: three or more are averaged as they are.
    """
    curves = [
        np.array(curves[name])
        for condition, curves in zip(report.conditions, report.curves, strict=True)
        if condition.alpha == level
    ]
    shortest = min(curve.shape[1] for curve in curves)
    time, mean, half = np.stack([c[:, :shortest] for c in curves], axis=1)
    between = 1.96 * mean.std(axis=0, ddof=len(mean) > 1) / np.sqrt(len(mean))
    within = np.sqrt(np.sum(half**2, axis=0)) / len(mean)
    return {
        "name": name,
        "alpha": level,
        "seconds": time[0].tolist(),
        "mean": mean.mean(axis=0).tolist(),
        "half": (between if len(mean) > 2 else within).tolist(),
    }


def measured(report: Report, levels: list[float]) -> list[dict]:
    """Everything drawn: curves by level, then means by level."""
    points = [pooled(report, name, level) for name in CURVES for level in levels]
    for name in BARS:
        for level in levels:
            found = paired.mean(report.rows, name, alpha=level)
            points.append({"name": name, "alpha": level, **asdict(found)})
    return points


def draw(points: list[dict], out: Path) -> None:
    """Two curves and two bars."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    widths = [2.0] * len(CURVES) + [1.0] * len(BARS)
    figure, axes = plt.subplots(
        1, len(widths), figsize=(15, 3.8), gridspec_kw={"width_ratios": widths}
    )
    for place, (name, title) in zip(axes, (CURVES | BARS).items(), strict=True):
        for p in (p for p in points if p["name"] == name):
            if name in CURVES:
                label = f"alpha = {p['alpha']:g}"
                time, mean, half = (np.array(p[k]) for k in ("seconds", "mean", "half"))
                place.plot(time, mean, label=label)
                place.fill_between(time, mean - half, mean + half, alpha=0.2, lw=0.0)
                continue
            bars = [[p["value"] - p["low"]], [p["high"] - p["value"]]]
            place.errorbar(
                [f"{p['alpha']:g}"], [p["value"]], bars, marker="o", capsize=3
            )
        place.set_title(title, fontsize=10)
        place.grid(alpha=0.3)
        place.set_xlabel("s since the bounce" if name in CURVES else "alpha")
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def main() -> None:
    options = paired.parser(__doc__, "fig5_trampoline", LEVELS)
    runtime.ensure()
    report = paired.evaluated(options, "trampoline", Path("runs/fig5_trampoline"))
    points = measured(report, options.alpha)
    paired.write(options.out, report.rows, points)
    draw(points, options.out)
    paired.tell([p for p in points if p["name"] in BARS], options.out)


if __name__ == "__main__":
    main()
