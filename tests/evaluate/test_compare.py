"""Which arms are compared, and by how much they differ: hand numbers."""

from __future__ import annotations

import numpy as np
import pytest

from dcc_jax.evaluate import bootstrap, compare
from dcc_jax.evaluate.compare import Condition, Part

RIGID, TOLD = Condition("a", 0.0), Condition("a", 0.16)
CONTROL = Condition("a", 0.16, u_on=False)


def _part(condition: Condition, *values: float) -> Part:
    rows = [{"x": value} for value in values]
    return Part(condition, rows, [[] for _ in rows], {}, {}, [])


def test_level_is_what_the_controller_gets_and_alpha_what_the_policy_observes():
    assert (TOLD.alpha, TOLD.level) == (0.16, 0.16)
    assert (CONTROL.alpha, CONTROL.level) == (0.16, 0.0)


def test_effect_of_compliance_is_u_on_less_u_off():
    parts = [
        _part(RIGID, 10.0, 20.0, 60.0),
        _part(TOLD, 14.0, 24.0, 64.0),
        _part(CONTROL, 11.0, 21.0, 61.0),
    ]
    level, control, effect = compare.comparisons(parts, bootstrap.draws(3))
    for comparison, difference in ((level, 4.0), (control, 1.0), (effect, 3.0)):
        found = comparison.difference["x"]
        # Every pair differs by as much: whatever is drawn, the mean is that.
        assert [found.low, found.value, found.high] == pytest.approx([difference] * 3)
    assert effect.ratio["x"].value == pytest.approx(102.0 / 93.0)


def test_effect_counts_the_pairs_that_have_both_arms():
    nan = np.nan
    parts = [_part(RIGID, 1, nan), _part(TOLD, 5, 7), _part(CONTROL, nan, 6)]
    level, control, effect = compare.comparisons(parts, bootstrap.draws(2))
    assert level.difference["x"].value == 4.0
    assert np.isnan(control.difference["x"].value)
    assert effect.difference["x"].value == 1.0


def test_arms_of_one_run_are_compared_with_its_first():
    low, low_control = Condition("a", 0.04), Condition("a", 0.04, u_on=False)
    arms = [RIGID, low, TOLD, low_control, CONTROL]
    assert compare.paired(arms) == [(1, 0), (2, 0), (3, 0), (4, 0), (1, 3), (2, 4)]


def test_arms_of_runs_with_one_level_each_are_compared_with_the_first_of_all():
    arms = [RIGID, Condition("b", 0.16), Condition("b", 0.16, u_on=False)]
    assert compare.paired(arms) == [(1, 0), (2, 0), (1, 2)]


def test_each_of_several_runs_has_its_own_baseline():
    arms = [RIGID, TOLD, Condition("b", 0.0), Condition("b", 0.16)]
    assert compare.paired(arms) == [(1, 0), (3, 2)]


def test_what_is_so_at_the_end_or_not_is_a_share():
    opened, draws = np.ones(64), bootstrap.draws(64)
    share = bootstrap.share(opened)
    assert share.low < 0.95
    for name in ("fell", "task/open/final"):
        assert compare.mean_or_share(name, opened, draws) == share
    for name, values in (("task/angle/final", 1.2 * opened), ("r_p", opened)):
        assert compare.mean_or_share(name, values, draws).low == values[0]
