"""The lines at the top of a page: forces, u, the speed of time, what went wrong."""

from __future__ import annotations

import html
import time

import numpy as np

from dcc_jax.play.simulation import Simulation

KEEPS_UP = 0.95  # share of the speed asked for below which it does not keep up
SETTLES = 1.0  # s: a shorter time says nothing about the speed


def text(
    note: str,
    loading: tuple[str, float] | None,
    simulation: Simulation | None,
    factor: float,
    wanted: float,
) -> str:
    """HTML of a few lines.

    Args:
        note: what went wrong or was saved, HTML.
        loading: the policy that is being compiled, and for how many seconds.
        simulation: what is played, if anything is.
        factor: simulated seconds a second.
        wanted: how many are asked for; 0 in a pause.
    """
    lines = [note] if note else []
    if loading is not None:
        name, waited = loading
        lines.append(f"compiling {bold(name)}: {waited:.0f} s; it moves when done")
    elif simulation is not None and simulation.history:
        lines += _numbers(simulation, factor, wanted)
    return "<br>".join(lines)


def plain(said: str) -> str:
    """Text as HTML: whatever it holds is shown as it is."""
    return html.escape(said)


def bold(said: str) -> str:
    """The same in bold."""
    return f"<b>{plain(said)}</b>"


def _numbers(simulation: Simulation, factor: float, wanted: float) -> list[str]:
    numbers = simulation.history[-1].numbers
    force = f"{numbers['force_peak']:.0f} N"
    turned = f"{np.degrees(numbers['displacement']):.1f} deg"
    away = f"{100 * numbers['root_displacement']:.1f} cm"
    speed = f"{factor:.2f} x real time"
    if wanted == 0.0:
        speed = "paused"
    elif factor < KEEPS_UP * wanted:
        speed = "🔴 " + bold(f"cannot keep up: {speed}")
    return [
        f"force {bold(force)}, u {bold(turned)}, {bold(away)}",
        f"{speed}, a control step takes {1e3 * simulation.step_seconds:.0f} ms",
        f"{simulation.falls} falls, none for {simulation.seconds_since_fall:.0f} s",
    ]


class Meter:
    """How fast the simulated time goes against the clock, over the last two seconds."""

    def __init__(self, wanted: float) -> None:
        """Begins anew: after a pause, or where another speed is asked for.

        Args:
            wanted: simulated seconds a second that are asked for.
        """
        self.wanted = wanted
        self._counted = 0.0
        self._marks = [(time.perf_counter(), 0.0)]

    def count(self, seconds: float) -> None:
        """So much was simulated."""
        self._counted += seconds

    def factor(self, now: float) -> float:
        """Simulated seconds a second; what is asked for until a second is over."""
        self._marks = [m for m in self._marks if now - m[0] < 2.0] or self._marks[-1:]
        since, counted = self._marks[0]
        self._marks.append((now, self._counted))
        if now - since < SETTLES:
            return self.wanted
        return (self._counted - counted) / (now - since)
