"""Intervals: hand numbers, and that they cover what they say."""

from __future__ import annotations

import numpy as np
import pytest

from dcc_jax.evaluate import bootstrap


def test_mean_ignores_episodes_without_a_value():
    values = np.array([1.0, np.nan, 3.0])
    found = bootstrap.mean(values, bootstrap.draws(3))
    assert found.value == 2.0
    assert 1.0 <= found.low < 2.0 < found.high <= 3.0


def test_nothing_to_average_is_nan_without_a_warning():
    found = bootstrap.mean(np.full(4, np.nan), bootstrap.draws(4))
    assert np.isnan([found.value, found.low, found.high]).all()


def test_interval_of_the_mean_covers_it_as_often_as_it_says():
    rng = np.random.default_rng(0)
    resamples = bootstrap.draws(60)
    found = [bootstrap.mean(rng.exponential(size=60), resamples) for _ in range(300)]
    covered = np.mean([interval.low <= 1.0 <= interval.high for interval in found])
    assert 0.90 <= covered <= 0.98


def test_pairs_make_a_ratio_certain_that_alone_would_not_be():
    rng = np.random.default_rng(1)
    baseline = rng.lognormal(sigma=1.0, size=100)
    values = 0.8 * baseline + 0.01 * rng.normal(size=100)
    resamples = bootstrap.draws(100)
    paired = bootstrap.ratio(values, baseline, resamples)
    strangers = bootstrap.ratio(rng.permutation(values), baseline, resamples)
    assert paired.low < 0.8 < paired.high
    assert paired.high - paired.low < 0.1 * (strangers.high - strangers.low)
    difference = bootstrap.difference(values, baseline, resamples)
    assert difference.value == pytest.approx(np.mean(values - baseline))
    assert difference.high < 0.0


def test_pair_with_one_half_missing_does_not_count():
    values, baseline = np.array([2.0, np.nan, 4.0]), np.array([1.0, 9.0, np.nan])
    assert bootstrap.ratio(values, baseline, bootstrap.draws(3)).value == 2.0


@pytest.mark.parametrize("seen", [0, 1, 7, 63, 64])
def test_interval_of_a_share_is_wilsons(seen):
    """Its ends are the shares p that lie z standard errors sqrt(p (1 - p) / n) away."""
    n, z = 64, 1.959964
    share = bootstrap.share(np.arange(n) < seen)
    assert share.value == seen / n
    for p, never in ((share.low, seen == 0), (share.high, seen == n)):
        if never:
            assert p == share.value
        else:
            away = abs(p - share.value)
            assert away == pytest.approx(z * np.sqrt(p * (1.0 - p) / n), rel=1e-6)
    assert share.low <= share.value <= share.high


@pytest.mark.parametrize("n", [10, 127, 128, 256])
def test_share_lies_in_its_interval_also_where_all_or_none_are_true(n):
    for value in (0.0, 1.0):
        share = bootstrap.share(np.full(n, value))
        assert share.low <= share.value == value <= share.high


def test_share_of_what_was_never_seen_is_not_certain():
    never = bootstrap.share(np.zeros(256))
    assert never.value == 0.0 and never.low == 0.0
    assert never.high == pytest.approx(0.0148, abs=1e-4)  # z^2 / (n + z^2)
    half = bootstrap.share(np.repeat([0.0, 1.0], 50))
    assert [half.low, half.high] == pytest.approx([0.4038, 0.5962], abs=1e-4)


def test_share_of_trials_is_less_certain_where_episodes_decide():
    rng = np.random.default_rng(3)
    good, episode = rng.random(40) < 0.5, np.repeat(np.arange(40), 10)
    resamples = bootstrap.draws(40)
    whole = bootstrap.share_of(good[episode], episode, resamples)
    assert whole.value == pytest.approx(good.mean())
    brute = good[resamples].mean(axis=1)  # all episodes are as long
    assert [whole.low, whole.high] == pytest.approx(np.percentile(brute, [2.5, 97.5]))
    alone = bootstrap.share(good[episode])
    assert whole.high - whole.low > 2.0 * (alone.high - alone.low)


def test_quantile_resamples_whole_episodes():
    rng = np.random.default_rng(2)
    values, episode = rng.normal(size=400), np.repeat(np.arange(40), 10)
    resamples = bootstrap.draws(40)
    found = bootstrap.quantile(values, episode, 0.9, resamples)
    assert found.value == np.sort(values)[359]
    brute = [
        np.sort(np.concatenate([values[episode == e] for e in row]))[359]
        for row in resamples[:200]
    ]
    few = bootstrap.quantile(values, episode, 0.9, resamples[:200])
    low, high = np.percentile(brute, [2.5, 97.5])
    assert [few.low, few.high] == pytest.approx([low, high])
