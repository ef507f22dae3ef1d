"""What a training says of itself in the end."""

from __future__ import annotations

import numpy as np
import pytest

from dcc_jax.training.verdict import verdict


def _rows(nearest: list[float], margin: float = 0.5) -> list[dict]:
    measured = {"style/floor": 0.004, "disc/margin": margin}
    return [measured | {"style/nearest": x} for x in nearest]


def test_nothing_is_said_before_anything_is_measured():
    assert verdict([{"update": 1.0}]) == ""


def test_a_measurement_of_environments_that_were_just_reset_is_left_out():
    rows = [*_rows([0.02, 0.01]), {"style/nearest": None, "style/floor": 0.004}]
    said = "the motion is 10 mm away from its clips, 2.5 times the floor"
    assert verdict(rows) == said


@pytest.mark.parametrize(
    ("nearest", "trend"),
    [
        ([0.06, 0.05, 0.04, 0.03, 0.02, 0.01], ", still falling"),
        ([0.01, 0.01, 0.01, 0.01, 0.01, 0.01], ", no longer falling"),
        ([0.01, 0.02, 0.03, 0.04, 0.05, 0.01], ", rising"),
        ([0.02, 0.01], ""),
    ],
)
def test_distance_is_told_with_its_trend(nearest, trend):
    expected = f"the motion is {1e3 * nearest[-1]:.0f} mm away from its clips, "
    expected += f"{nearest[-1] / 0.004:.1f} times the floor"
    assert verdict(_rows(nearest)) == expected + trend


@pytest.mark.parametrize(
    ("r_q", "expected"),
    [
        (np.linspace(0.5, 0.7, 20), "r_q = 0.69, of 1 at most, still rising"),
        (np.linspace(0.7, 0.5, 20), "r_q = 0.51, of 1 at most, falling"),
        (np.full(40, 0.7), "r_q = 0.70, of 1 at most, no longer rising"),
    ],
)
def test_where_no_discriminator_learns_the_reward_of_tracking_is_told(r_q, expected):
    rows = [{"reward/r_q": x, "style/nearest": 0.1, "style/floor": 0.0} for x in r_q]
    assert verdict(rows) == f"it follows its reference with {expected}"
    assert verdict(rows[:9]) == ""


@pytest.mark.parametrize(("margin", "won"), [(1.8, True), (1.2, False)])
def test_a_discriminator_that_has_won_is_named(margin, won):
    assert ("the discriminator has won" in verdict(_rows([0.01], margin))) == won
