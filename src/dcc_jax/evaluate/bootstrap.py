"""Shares, means and paired ratios with their intervals.

Letters: N episodes, R resamples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

RESAMPLES = 2000
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95 % interval; NaN where there is nothing to estimate."""

    value: float
    low: float
    high: float


def draws(count: int, seed: int = 0) -> np.ndarray:
    """Which episodes [R, N] make each resample."""
    return np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))


def mean(values: np.ndarray, resamples: np.ndarray) -> Interval:
    """Mean of values [N] over the episodes that have one (the others are NaN)."""
    return _interval(_mean(values), _mean(values[resamples]))


def share(values: np.ndarray) -> Interval:
    """Share of true values [N], with Wilson's interval (1927).

    A bootstrap would claim certainty where nothing was ever seen to happen.
    """
    seen = scipy.stats.binomtest(int(np.sum(values)), len(values))
    found = seen.proportion_ci(LEVEL, method="wilson")
    return Interval(float(seen.statistic), float(found.low), float(found.high))


def ratio(values: np.ndarray, baseline: np.ndarray, resamples: np.ndarray) -> Interval:
    """Mean of values [N] over mean of the baseline [N], pair by pair resampled.

    Episodes in which either is undefined do not count.
    """
    values, baseline = _paired(values, baseline)
    with np.errstate(divide="ignore", invalid="ignore"):
        estimate = _mean(values) / _mean(baseline)
        return _interval(
            estimate, _mean(values[resamples]) / _mean(baseline[resamples])
        )


def difference(
    values: np.ndarray, baseline: np.ndarray, resamples: np.ndarray
) -> Interval:
    """Mean of values [N] less mean of the baseline [N], pair by pair."""
    values, baseline = _paired(values, baseline)
    return mean(values - baseline, resamples)


def quantile(
    values: np.ndarray, episode: np.ndarray, q: float, resamples: np.ndarray
) -> Interval:
    """A quantile of values [K] of episodes [K]; whole episodes are resampled."""
    if len(values) == 0:
        return _interval(np.nan, np.full(2, np.nan))
    order = np.argsort(values)
    values, episode = values[order], episode[order]
    count = resamples.shape[1]
    times = np.stack([np.bincount(row, minlength=count) for row in resamples])
    reached = np.cumsum(times[:, episode], axis=1)
    at = (reached >= q * reached[:, -1:]).argmax(axis=1)
    value = np.quantile(values, q, method="inverted_cdf")  # as in the resamples
    return _interval(float(value), values[at])


def share_of(
    values: np.ndarray, episode: np.ndarray, resamples: np.ndarray
) -> Interval:
    """Share of true values [K] of episodes [K]; whole episodes are resampled."""
    if len(values) == 0:
        return _interval(np.nan, np.full(2, np.nan))
    count = resamples.shape[1]
    true = np.bincount(episode, values, count)[resamples].sum(axis=1)
    every = np.bincount(episode, minlength=count)[resamples].sum(axis=1)
    with np.errstate(invalid="ignore"):
        return _interval(float(np.mean(values)), true / every)


def _paired(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    missing = np.isnan(a) | np.isnan(b)
    return np.where(missing, np.nan, a), np.where(missing, np.nan, b)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis without NaN, without a warning where all are."""
    valid = ~np.isnan(values)
    total = np.where(valid, values, 0.0).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return total / valid.sum(axis=-1)


def _interval(value: float | np.ndarray, resampled: np.ndarray) -> Interval:
    finite = resampled[np.isfinite(resampled)]
    if finite.size == 0 or not np.isfinite(value):
        return Interval(float(value), np.nan, np.nan)
    tail = 50.0 * (1.0 - LEVEL)
    low, high = np.percentile(finite, [tail, 100.0 - tail])
    return Interval(float(value), float(low), float(high))
