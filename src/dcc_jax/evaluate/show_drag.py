"""A drag as a table, a figure and json."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.drag import NEAR, SEEN, Drag, slope
from dcc_jax.evaluate.dragging import BODIES

COLOURS = ("#1f6fb4", "#c8553d", "#3a7d44", "#8a5fb0")


def table(name: str, drags: Sequence[Drag]) -> Table:
    """A row a body and level: stiffness by theory and as measured."""
    page = Table(title=f"{name}: stiffness while dragged", title_justify="left")
    for column in (
        "body",
        "alpha",
        "theory, N/m",
        "measured, N/m [95 %]",
        f"within {NEAR:.0%} [95 %]",
        f"of yields from {100 * SEEN:g} cm on",
        "fell",
    ):
        page.add_column(column, justify="left" if column == "body" else "right")
    for body in BODIES:
        for drag in drags:
            found = drag.stiffness(body)
            near, seen = drag.share_near(body), drag.share_near(body, SEEN)
            fell = drag.fell[drag.body == BODIES.index(body)].mean()
            page.add_row(
                body,
                f"{drag.alpha:g}",
                f"{drag.expected(body):.0f}",
                _interval(found, ".0f"),
                _interval(near, ".0%"),
                _interval(seen, ".0%"),
                f"{fell:.0%}",
            )
        if len(drags) > 1:
            page.add_row(body, "", "", f"log-log slope {slope(drags, body):.2f}")
        page.add_section()
    return page


def _interval(of: Interval, form: str) -> str:
    if np.isnan(of.value):  # no trial ended upright
        return "-"
    return f"{of.value:{form}} [{of.low:{form}}, {of.high:{form}}]"


def to_json(name: str, drags: Sequence[Drag]) -> str:
    """Every trial."""
    data: dict[str, Any] = {"run": name, "bodies": BODIES, "levels": []}
    for drag in drags:
        rows = {
            column: np.asarray(getattr(drag, column)).tolist()
            for column in ("body", "episode", "newtons", "measured", "theory", "fell")
        }
        data["levels"].append({"alpha": drag.alpha, **rows})
    return json.dumps(data) + "\n"


def figure(name: str, drags: Sequence[Drag], out: Path) -> None:
    """Told against measured stiffness, a panel a body, both axes logarithmic."""
    page = Figure(figsize=(3.4 * len(BODIES), 3.6), layout="constrained")
    FigureCanvasAgg(page)
    for axes, body, colour in zip(
        page.subplots(1, len(BODIES)), BODIES, COLOURS, strict=True
    ):
        told = np.array([drag.expected(body) for drag in drags])
        found = [drag.stiffness(body) for drag in drags]
        value = np.array([x.value for x in found])
        sides = np.array([[x.value - x.low, x.high - x.value] for x in found]).T
        axes.errorbar(told, value, np.maximum(sides, 0.0), fmt="o-", color=colour)
        ends = np.array([np.nanmin(told), np.nanmax(told)])
        axes.plot(ends, ends, color="0.5", lw=0.8)
        near = ends * (1.0 - NEAR), ends * (1.0 + NEAR)
        axes.fill_between(ends, *near, color="0.5", alpha=0.15)
        axes.set(xscale="log", yscale="log", xlabel="by theory, N/m", title=body)
    page.axes[0].set_ylabel("measured, N/m")
    page.suptitle(f"{name}: stiffness while dragged")
    page.savefig(out, dpi=110)
