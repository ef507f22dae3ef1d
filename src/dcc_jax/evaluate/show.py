"""An evaluation as a table and as a page of figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table

from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.compare import POOLED, Comparison
from dcc_jax.evaluate.measures import CURVES, DT, METRICS
from dcc_jax.evaluate.report import Report

COLOURS = ("#1f6fb4", "#c8553d", "#3a7d44", "#8a5fb0", "#b8860b", "#555555")
COMPARED = (
    "contact/peak",
    "contact/impulse",
    "contact/seconds",
    "contact/torque",
    "torque/rms",
    "power",
    "skate",
    "style/nearest",
)
"""Metrics whose ratios are drawn; the first and the fourth are Fig. 4."""
NO_RATIO = ("fell", "u/", "contact/energy", "contact/foot", "energy", "range", "task/")
"""Metrics that may be zero or of either sign: differences are shown."""
COLUMNS = 3


def table(report: Report) -> Group:
    """Two tables, a row a metric: the conditions, then what they are compared."""
    means = _table(
        f"{_title(report)}; means [95 % interval]",
        [_name(report, i) for i, _ in enumerate(report.conditions)],
    )
    compared = _table(
        "paired ratios of means, or differences [95 % interval]",
        [_versus(report, comparison) for comparison in report.comparisons],
    )
    for name in _ordered(report.summary[0]):
        means.add_row(_row_name(name), *[_text(s[name]) for s in report.summary])
    for name in _ordered(report.rows[0]) if report.comparisons else ():
        if name in report.comparisons[0].ratio:
            compared.add_row(
                _row_name(name), *[_compared(c, name) for c in report.comparisons]
            )
    return Group(means, compared) if report.comparisons else Group(means)


def _ordered(metrics: Iterable[str]) -> list[str]:
    """Who falls, then the task's own metrics, then all others."""
    first = "fell", "survived"
    return sorted(metrics, key=lambda m: (m not in first, not m.startswith("task/")))


def _table(title: str, columns: list[str]) -> Table:
    page = Table(title=title, title_justify="left")
    page.add_column("", no_wrap=True)
    for column in columns:
        page.add_column(column, justify="right")
    return page


def _row_name(metric: str) -> str:
    unit = (METRICS | POOLED).get(metric, ("", ""))[0]
    return f"{metric} ({unit})" if unit else metric


def check_format(path: Path) -> None:
    """Raises ValueError where the ending of a picture's name is no known format."""
    ending = path.suffix.lstrip(".").lower()
    known = FigureCanvasAgg(Figure()).get_supported_filetypes()
    if ending not in known:
        raise ValueError(
            f"--figure {path}: cannot write {ending!r} pictures, only "
            f"{', '.join(sorted(known))}"
        )


def figure(report: Report, path: Path) -> None:
    """Writes a page: who stands, how hard contacts are, ratios, and curves over time.

    Control arms are dashed.
    Curves show the mean over episodes and its 95 % interval.
    """
    names = [name for name, *_ in CURVES] + sorted(
        {n for curves in report.curves for n in curves if n.startswith("task/")}
    )
    drawn = [n for n in names if any(c[n][0] for c in report.curves)]
    count = 3 + len(drawn)
    lines = -(-count // COLUMNS)
    page = Figure(figsize=(5.2 * COLUMNS, 3.2 * lines + 0.5), layout="constrained")
    FigureCanvasAgg(page)
    axes = page.subplots(lines, COLUMNS, squeeze=False).ravel()
    _draw_survival(axes[0], report)
    _draw_peaks(axes[1], report)
    _draw_ratios(axes[2], report)
    for place, name in zip(axes[3:], drawn, strict=False):
        _draw_curve(place, report, name)
    for place in axes[count:]:
        place.axis("off")
    page.suptitle(_title(report))
    page.savefig(path, dpi=90)


def _draw_survival(axes: Axes, report: Report) -> None:
    for i, share in enumerate(report.survival):
        time = DT * np.arange(1, len(share) + 1)
        axes.plot(time, share, **_line(report, i), label=_name(report, i))
    axes.set(title="share still standing", xlabel="s", ylim=(-0.03, 1.03))
    axes.legend(fontsize=8, loc="lower left")


def _draw_peaks(axes: Axes, report: Report) -> None:
    for i, condition in enumerate(report.conditions):
        here = asdict(condition).items()
        peaks = sorted(c["peak"] for c in report.contacts if here <= c.items())
        axes.plot(peaks, np.linspace(0.0, 1.0, len(peaks)), **_line(report, i))
    axes.set(title="peak force of a contact: share below", xlabel="N")


def _draw_ratios(axes: Axes, report: Report) -> None:
    axes.axvline(1.0, color="0.6", lw=0.8)
    shown = [c for c in report.comparisons if report.conditions[c.baseline].u_on]
    for c, comparison in enumerate(shown):
        style = _line(report, comparison.condition)
        for line, name in enumerate(COMPARED):
            ratio = comparison.ratio[name]
            height = -line - 0.15 * c
            axes.plot([ratio.low, ratio.high], [height] * 2, **style)
            axes.plot(ratio.value, height, "o", color=style["color"], ms=4)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, 0.9), max(high, 1.1))
    axes.set_yticks(-np.arange(len(COMPARED)), COMPARED, fontsize=8)
    baselines = {_name(report, c.baseline) for c in report.comparisons}
    baseline = baselines.pop() if len(baselines) == 1 else "its baseline"
    axes.set_title(f"ratio of means to {baseline}")


def _draw_curve(axes: Axes, report: Report, name: str) -> None:
    for i, curves in enumerate(report.curves):
        time, mean, half = map(np.array, curves[name])
        style = _line(report, i)
        axes.plot(time, mean, **style)
        axes.fill_between(
            time, mean - half, mean + half, color=style["color"], alpha=0.2, lw=0.0
        )
    unit = dict(CURVES).get(name)
    since = report.clock or "since the reset"
    axes.set(
        title=f"{name} ({unit})" if unit else name,
        xlabel=f"s {since.replace('_', ' ')}",
    )


def _title(report: Report) -> str:
    count = len(report.rows) // len(report.conditions)
    imitation = " and ".join(sorted(set(report.imitation.values())))
    return (
        f"{report.task}, {imitation}: {count} episodes of at most "
        f"{report.seconds:g} s, seed {report.seed}, the same perturbations for all"
    )


def _name(report: Report, i: int) -> str:
    condition = report.conditions[i]
    several = len({c.run for c in report.conditions}) > 1
    run = f"{Path(condition.run).name} " if several else ""
    return f"{run}alpha {condition.alpha:g}{'' if condition.u_on else ', u off'}"


def _versus(report: Report, comparison: Comparison) -> str:
    condition, baseline = (
        _name(report, i) for i in (comparison.condition, comparison.baseline)
    )
    if baseline == f"{condition}, u off":
        return f"{condition}: u on / u off"
    return f"{condition} / {baseline}"


def _compared(comparison: Comparison, name: str) -> str:
    """The ratio of means, or the difference where a ratio says nothing."""
    if name not in comparison.ratio:
        return ""
    if name.startswith(NO_RATIO):
        return f"diff {_text(comparison.difference[name])}"
    return _text(comparison.ratio[name])


def _text(interval: Interval) -> str:
    if np.isnan(interval.value):
        return "-"
    if np.isnan(interval.low):
        return f"{interval.value:.3g}"
    return f"{interval.value:.3g} [{interval.low:.3g}, {interval.high:.3g}]"


def _line(report: Report, i: int) -> dict[str, Any]:
    """Colour and dashes of a condition: a control arm has its level's colour."""
    condition = report.conditions[i]
    levels = [(c.run, c.alpha) for c in report.conditions if c.u_on]
    place = levels.index((condition.run, condition.alpha))
    return {
        "color": COLOURS[place % len(COLOURS)],
        "linestyle": "-" if condition.u_on else "--",
    }
