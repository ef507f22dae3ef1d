"""What a control step cost, by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.env import metrics

H = 0.01  # s


def _after(*forces: list[list[float]]) -> metrics.Sums:
    sums, nothing = metrics.no_sums(jnp.zeros(())), jnp.zeros(36)
    for force in forces:
        sums = metrics.add(sums, jnp.array(force), nothing, nothing, H)
    return sums


def test_a_load_counts_the_same_however_many_contacts_carry_it():
    one = _after([[0.0, 0.0, 300.0], [0.0, 0.0, 0.0]])
    two = _after([[0.0, 0.0, 100.0], [0.0, 0.0, 200.0]])
    for sums in (one, two):
        assert float(sums.force_peak) == pytest.approx(300.0)
        assert float(sums.impulse) == pytest.approx(3.0)


def test_forces_against_each_other_do_not_cancel():
    squeezed = _after([[0.0, 40.0, 0.0], [0.0, -40.0, 0.0]])
    assert float(squeezed.force_peak) == pytest.approx(80.0)


def test_the_peak_is_the_largest_and_the_impulse_the_sum_over_steps():
    sums = _after([[3.0, 0.0, 4.0]], [[0.0, 2.0, 0.0]], [[0.0, 0.0, 0.0]])
    assert float(sums.force_peak) == pytest.approx(5.0)
    assert float(sums.impulse) == pytest.approx(0.07)
    np.testing.assert_array_equal(sums.contact_steps, 2)
