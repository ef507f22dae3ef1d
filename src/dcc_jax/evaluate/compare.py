"""Conditions summed up, and compared in pairs of episodes.

Letters: N episodes, R resamples of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcc_jax.evaluate import bootstrap
from dcc_jax.evaluate.bootstrap import Interval

POOLED = {
    "contact/peak_p95": ("N", "95 % quantile of the contacts' largest forces"),
    "contact/peak_max": ("N", "the largest of all"),
    "style/frechet": ("m", "Frechet distance of pose pairs to those of the clips"),
    "broken": ("", "episodes in which the physics broke"),
}
"""Metrics of a condition that are none of one episode: unit and meaning."""


@dataclass(frozen=True)
class Condition:
    """A policy at a level of compliance."""

    run: str
    alpha: float


@dataclass(frozen=True)
class Part:
    """A condition, played and measured."""

    condition: Condition
    rows: list[dict[str, float]]
    contacts: list[list[dict[str, float]]]  # of each episode
    pooled: dict[str, float]
    curves: dict[str, list[list[float]]]
    survival: list[float]


@dataclass(frozen=True)
class Comparison:
    """A condition against its run's first, or the first of all if each run has one."""

    condition: int  # index into Report.conditions
    baseline: int
    ratio: dict[str, Interval]  # by metric, of the means
    difference: dict[str, Interval]


def comparisons(parts: list[Part], resamples: np.ndarray) -> list[Comparison]:
    """Each condition against its baseline; arguments as of `summary`."""
    several = any(p.condition.run == parts[0].condition.run for p in parts[1:])
    found = []
    for i, part in enumerate(parts):
        same = [j for j, p in enumerate(parts) if p.condition.run == part.condition.run]
        baseline = same[0] if several else 0
        if i != baseline:
            found.append(_compared(parts, i, baseline, resamples))
    return found


def summary(part: Part, resamples: np.ndarray) -> dict[str, Interval]:
    """Every metric of a condition, the pooled ones included.

    Args:
        part: the condition.
        resamples: of its episodes [R, N].
    """
    columns = {name: _column(part, name) for name in part.rows[0]}
    found = {
        name: bootstrap.share(values)
        if name == "fell"
        else bootstrap.mean(values, resamples)
        for name, values in columns.items()
    }
    peaks = [(c["peak"], n) for n, cs in enumerate(part.contacts) for c in cs]
    values, episode = np.array(peaks).reshape(-1, 2).T
    nothing = np.nan, np.nan
    found["contact/peak_p95"] = bootstrap.quantile(
        values, episode.astype(int), 0.95, resamples
    )
    found["contact/peak_max"] = Interval(values.max(initial=0.0), *nothing)
    return found | {k: Interval(v, *nothing) for k, v in part.pooled.items()}


def _compared(
    parts: list[Part], i: int, baseline: int, resamples: np.ndarray
) -> Comparison:
    pairs = {
        name: (_column(parts[i], name), _column(parts[baseline], name), resamples)
        for name in parts[i].rows[0]
    }
    return Comparison(
        condition=i,
        baseline=baseline,
        ratio={name: bootstrap.ratio(*pair) for name, pair in pairs.items()},
        difference={name: bootstrap.difference(*pair) for name, pair in pairs.items()},
    )


def _column(part: Part, name: str) -> np.ndarray:
    return np.array([row[name] for row in part.rows])
