"""Ten seconds of a few numbers, drawn over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.play.simulation import HISTORY, Moment

Column = Callable[[Moment], float]


@dataclass(frozen=True)
class Chart:
    """A picture of some numbers over time."""

    title: str
    lines: dict[str, Column]


CHARTS = (
    Chart("force, N", {"force": lambda m: m.numbers["force_peak"]}),
    Chart(
        "displacement u",
        {
            "joints, deg": lambda m: float(np.degrees(m.numbers["displacement"])),
            "root, cm": lambda m: 100.0 * m.numbers["root_displacement"],
        },
    ),
    Chart("RMS torque, N m", {"torque": lambda m: m.numbers["torque_rms"]}),
    Chart(
        "reward",
        {
            "r_q": lambda m: m.numbers["r_q"],
            "r_p": lambda m: m.numbers["r_p"],
            "r_task": lambda m: m.numbers["r_task"],
        },
    ),
)
COLOURS = ("#f2590f", "#2b6cb0", "#3caa5a")


class Plots:
    """The charts of a page."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._handles = [
            gui.add_uplot(
                data(chart, []),
                series=(
                    {"label": "s"},
                    *(
                        {"label": name, "stroke": colour, "width": 1.5}
                        for name, colour in zip(chart.lines, COLOURS, strict=False)
                    ),
                ),
                title=chart.title,
                scales={"x": {"time": False}},
                legend={"show": len(chart.lines) > 1},
                height=130,
            )
            for chart in CHARTS
        ]

    def show(self, history: Sequence[Moment]) -> None:
        """Draws what is remembered."""
        for chart, handle in zip(CHARTS, self._handles, strict=True):
            handle.data = data(chart, history)


def data(chart: Chart, history: Sequence[Moment]) -> tuple[np.ndarray, ...]:
    """s before now, then every line; NaN where nothing is remembered yet."""
    seconds = np.arange(1 - HISTORY, 1) / CONTROL_RATE
    rows = np.full((len(chart.lines), HISTORY), np.nan)
    if history:
        columns = [[line(m) for m in history] for line in chart.lines.values()]
        rows[:, HISTORY - len(history) :] = columns
    return seconds, *rows
