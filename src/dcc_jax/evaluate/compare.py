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
    """An arm: a policy that observes alpha, with or without what alpha does.

    A policy that observes alpha may stand differently for it, and would do so without
    any compliance. The control arm, with u off, tells the two apart.
    """

    run: str
    alpha: float  # that the policy observes, or the nearest it was trained with
    u_on: bool = True  # False: the compliance controller displaces nothing

    @property
    def level(self) -> float:
        """The alpha of the compliance controller."""
        return self.alpha if self.u_on else 0.0


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
    """A condition against another one, episode by episode."""

    condition: int  # index into Report.conditions
    baseline: int
    ratio: dict[str, Interval]  # by metric, of the means
    difference: dict[str, Interval]


def comparisons(parts: list[Part], resamples: np.ndarray) -> list[Comparison]:
    """What is compared; arguments as of `summary`."""
    pairs = paired([part.condition for part in parts])
    return [_compared(parts, i, j, resamples) for i, j in pairs]


def paired(conditions: list[Condition]) -> list[tuple[int, int]]:
    """Which condition is compared with which, as indices.

    Every condition with the baseline: the first of its run, or the first of all where
    each run has one level. Then those with u on with their control arms: since
    (on - baseline) - (off - baseline) = on - off, that is the effect of compliance
    alone, what the policy does on being told alpha taken away.
    """
    levels = [i for i, c in enumerate(conditions) if c.u_on]
    several = len({conditions[i].run for i in levels}) < len(levels)
    found, effects = [], []
    for i, c in enumerate(conditions):
        same = [j for j in levels if conditions[j].run == c.run]
        baseline = same[0] if several else levels[0]
        if i != baseline:
            found.append((i, baseline))
        if not c.u_on:
            effects += [(j, i) for j in same if conditions[j].alpha == c.alpha]
    return found + effects


def summary(part: Part, resamples: np.ndarray) -> dict[str, Interval]:
    """Every metric of a condition, the pooled ones included.

    Args:
        part: the condition.
        resamples: of its episodes [R, N].
    """
    columns = {name: _column(part, name) for name in part.rows[0]}
    found = {
        name: mean_or_share(name, values, resamples) for name, values in columns.items()
    }
    peaks = [(c["peak"], n) for n, cs in enumerate(part.contacts) for c in cs]
    values, episode = np.array(peaks).reshape(-1, 2).T
    nothing = np.nan, np.nan
    found["contact/peak_p95"] = bootstrap.quantile(
        values, episode.astype(int), 0.95, resamples
    )
    found["contact/peak_max"] = Interval(values.max(initial=0.0), *nothing)
    return found | {k: Interval(v, *nothing) for k, v in part.pooled.items()}


def mean_or_share(name: str, values: np.ndarray, resamples: np.ndarray) -> Interval:
    """A share where a metric [N] says of each episode whether something was so.

    That are `fell` and what a task has as yes or no at the end, such as an open door.
    """
    yes_or_no = name == "fell" or name.endswith("/final")
    if yes_or_no and np.isin(values, (0.0, 1.0)).all():
        return bootstrap.share(values)
    return bootstrap.mean(values, resamples)


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
