"""What a training says of itself in the end."""

from __future__ import annotations

import pytest

from dcc_jax.training.verdict import verdict


def _rows(nearest: list[float], margin: float | None = None) -> list[dict]:
    rows = [{"style/nearest": x, "style/floor": 0.004} for x in nearest]
    if margin is not None:
        rows = [row | {"disc/margin": margin} for row in rows]
    return rows


def test_nothing_is_said_before_anything_is_measured():
    assert verdict([{"update": 1.0}]) == ""


def test_a_measurement_of_environments_that_were_just_reset_is_left_out():
    rows = [*_rows([0.02, 0.01]), {"style/nearest": None, "style/floor": 0.004}]
    assert verdict(rows) == "the motion is 10 mm away from its clips"


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
    expected = f"the motion is {1e3 * nearest[-1]:.0f} mm away from its clips"
    assert verdict(_rows(nearest)) == expected + trend


def test_distance_is_told_in_floors_where_a_discriminator_learns():
    said = verdict(_rows([0.02, 0.01], margin=0.5))
    assert said == "the motion is 10 mm away from its clips, 2.5 times the floor"


@pytest.mark.parametrize(("margin", "won"), [(1.8, True), (1.2, False)])
def test_a_discriminator_that_has_won_is_named(margin, won):
    assert ("the discriminator has won" in verdict(_rows([0.01], margin))) == won
