"""Rows, contacts and curves of recordings made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dcc_jax.evaluate import measures
from dcc_jax.evaluate.measures import DT
from dcc_jax.play.recording import Recording

ZERO = (
    *("force_peak", "impulse", "contact_share", "torque_rms", "contact_torque"),
    *("torque_peak", "power", "displacement", "root_displacement", "kinetic"),
    *("energy", "foot_height", "pelvis_height", "slip", "stands", "range_excess"),
    *("r_p", "r_task"),
)


def _recording(lasting: list[int], steps: int = 10, **numbers: np.ndarray) -> Recording:
    """Episodes that last so many of the steps; those that end early fell."""
    count = len(lasting)
    alive = np.arange(steps)[:, None] < np.array(lasting)
    shape = {name: np.zeros((steps, count)) for name in ZERO}
    return Recording(
        alive=alive,
        fell=np.array(lasting) < steps,
        nan=np.zeros(count, bool),
        numbers=shape | numbers,
        motion=None,
        pairs=np.zeros((2, count, 3)),
        pairs_alive=np.array([alive[4], alive[9]]),
    )


def _column(*values: float) -> np.ndarray:
    return np.array(values)[:, None]


def test_contact_goes_on_as_long_as_a_force_acts():
    recording = _recording(
        [10],
        contact_share=_column(0, 0.5, 1, 0, 0, 0, 0.25, 0, 0, 0),
        force_peak=_column(0, 100, 300, 0, 0, 0, 50, 0, 0, 0),
        impulse=_column(0, 1, 8, 0, 0, 0, 0.5, 0, 0, 0),
        contact_torque=_column(0, 10, 40, 0, 0, 0, 20, 0, 0, 0),
        foot_height=_column(0, -0.1, -0.2, -0.9, 0, 0, 0.1, 0, 0, 0),
        energy=_column(500, 490, 460, 0, 0, 0, 10, 0, 0, 0),
    )
    first, second = measures.contacts_of(recording, 0)
    assert first == {
        "start": pytest.approx(DT),
        "peak": 300.0,
        "impulse": 9.0,
        "seconds": pytest.approx(1.5 * DT),
        "torque": pytest.approx(np.sqrt((0.5 * 10**2 + 40**2) / 1.5)),
        "foot_low": -0.2,
        "pelvis_low": 0.0,
        "energy": -40.0,
    }
    assert second["peak"] == 50.0 and second["seconds"] == pytest.approx(0.25 * DT)


def test_row_ends_where_the_episode_does():
    recording = _recording(
        [4, 10],
        displacement=np.stack([np.arange(10.0), np.arange(10.0)], axis=1),
        torque_rms=np.full((10, 2), 3.0),
        impulse=np.ones((10, 2)),
        **{"task/angle": np.stack([np.arange(10.0), -np.arange(10.0)], axis=1)},
    )
    contacts = [[], [{name: 1.0 for name in _CONTACT}]]
    nearest = np.array([[0.1, 0.2], [0.3, 0.4]])
    short, whole = measures.rows(recording, nearest, contacts, None)
    assert short["fell"] == 1.0 and whole["fell"] == 0.0
    assert short["survived"] == pytest.approx(4 * DT)
    assert short["u/joints_max"] == 3.0 and whole["u/joints_max"] == 9.0
    assert short["torque/rms"] == pytest.approx(3.0)
    assert short["force/mean"] == pytest.approx(1.0 / DT)
    assert np.isnan(short["contact/peak"]) and whole["contact/peak"] == 1.0
    # The first chunk of five steps was never finished by the short one.
    assert np.isnan(short["style/nearest"])
    assert whole["style/nearest"] == pytest.approx(0.3)
    angle = {kind: short[f"task/angle/{kind}"] for kind in ("mean", "max", "final")}
    assert angle == {"mean": 1.5, "max": 3.0, "final": 3.0}
    assert whole["task/angle/min"] == -9.0
    assert set(measures.METRICS) <= short.keys()


_CONTACT = (
    *("start", "peak", "impulse", "seconds", "torque", "foot_low", "pelvis_low"),
    "energy",
)


def test_skate_is_slip_by_time_that_soles_stand():
    recording = _recording(
        [10],
        slip=_column(0.1, 0.3, 0, 0, 0, 0, 0, 0, 0, 0),
        stands=_column(1, 1, 1, 1, 0, 0, 0, 0, 0, 0),
    )
    (row,) = measures.rows(recording, np.zeros((2, 1)), [[]], None)
    assert row["skate"] == pytest.approx(0.4 / (4 * DT))


def test_curves_are_aligned_by_the_clock_and_begin_with_its_first_event():
    clock = (np.arange(60)[:, None] + np.array([0, 7])) % 20 * DT
    value = np.where(np.arange(60)[:, None] < 13, 99.0, np.round(clock / DT) // 3)
    recording = _recording([60, 60], 60, energy=value, **{"task/since": clock})
    time, mean, half = measures.curves(recording, "since")["energy"]
    # The second episode's clock starts anew after 13 steps, the first one's after 20.
    np.testing.assert_allclose(time, (np.arange(7) + 0.5) * 3 * DT)
    np.testing.assert_allclose(mean, np.arange(7))
    np.testing.assert_allclose(half, 0.0, atol=1e-9)
    assert "task/since" not in measures.curves(recording, "since")


def test_half_width_is_of_episodes_not_of_steps():
    values = np.ones((30, 1)) * np.array([1.0, 2.0, 3.0, 6.0])
    recording = _recording([30] * 4, 30, energy=values)
    _, mean, half = measures.curves(recording, None)["energy"]
    assert mean[0] == pytest.approx(3.0)
    assert half[0] == pytest.approx(1.96 * values[0].std(ddof=1) / 2.0)


def test_survival_counts_falls_alone():
    recording = _recording([4, 10, 10, 10])
    assert measures.survival(recording) == [1.0] * 4 + [0.75] * 6
