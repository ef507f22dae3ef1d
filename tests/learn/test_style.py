"""Distances to the clips: hand numbers, closed forms, scipy."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from dcc_jax.env.pairs import (
    COLUMN_ARM,
    VELOCITY_TIME,
    Weights,
    pair_coordinates,
    seen,
    weighed,
)
from dcc_jax.learn import style
from toy import Toy

DT = 1.0 / 30.0
WEIGHTS = Weights(velocity_time=0.05, turn_arm=0.3)


@pytest.fixture(scope="module")
def reference() -> style.Reference:
    """The pairs of the toy's clips: four numbers, correlated."""
    return jax.jit(lambda: style.make_reference(Toy()))()


def _clip_pairs(seed: int, count: int) -> jax.Array:
    s, s_next, _ = Toy().expert_pairs(jax.random.key(seed), jnp.ones(count, jnp.int32))
    return Toy().style_coordinates(s, s_next)


def test_pairs_of_the_clips_are_on_themselves(reference):
    np.testing.assert_allclose(
        style.nearest(reference, reference.pairs[:50]), 0.0, atol=1e-3
    )


def test_nearest_is_that_of_all_distances(reference):
    points = 2.0 * _clip_pairs(1, 40) + 0.3
    apart = np.asarray(points)[:, None] - np.asarray(reference.pairs)
    expected = np.linalg.norm(apart, axis=-1).min(axis=1)
    np.testing.assert_allclose(style.nearest(reference, points), expected, atol=1e-4)


def test_frechet_distance_of_shifted_clips_is_the_shift(reference):
    shift = jnp.array([0.3, 0.0, -0.4, 0.0])
    moved = reference.pairs + shift
    ones = jnp.ones(len(moved))
    assert float(style.frechet(reference, moved, ones)) == pytest.approx(0.5, rel=1e-3)
    assert float(style.frechet(reference, reference.pairs, ones)) < 1e-3


def test_frechet_distance_is_that_of_the_matrix_square_root(reference):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 4)) @ rng.normal(size=(4, 4)) + 0.1
    weight = rng.integers(0, 3, size=300)
    counted = np.repeat(points, weight, axis=0)
    first = np.cov(np.asarray(reference.pairs, float).T, bias=True)
    second = np.cov(counted.T, bias=True)
    gap = counted.mean(0) - np.asarray(reference.pairs).mean(0)
    cross = scipy.linalg.sqrtm(first @ second).real
    expected = np.sqrt(gap @ gap + np.trace(first + second - 2.0 * cross))
    found = style.frechet(reference, jnp.array(points), jnp.array(weight, jnp.float32))
    assert float(found) == pytest.approx(expected, rel=1e-3)


def test_fewer_kinds_of_motion_show_in_the_frechet_distance_alone(reference):
    """A policy that stays in one place of the clips does nothing wrong, but little."""
    all_of_it = _clip_pairs(5, 500)
    middle = all_of_it[jnp.linalg.norm(all_of_it, axis=1) < 0.15]
    whole, part = (
        style.measure(reference, points, jnp.ones(len(points)))
        for points in (all_of_it, middle)
    )
    assert float(part["style/nearest"]) <= float(whole["style/nearest"])
    assert float(part["style/frechet"]) > 3.0 * float(whole["style/frechet"])


def test_environments_that_were_just_reset_do_not_count():
    pairs = _clip_pairs(2, 8)
    env = SimpleNamespace(
        previous_features=pairs[:, :2].at[0].set(100.0), features=pairs[:, 2:]
    )
    steps = jnp.array([0, 1, 2, 3, 4, 5, 6, 7])
    measured = style.of_running(Toy(), SimpleNamespace(env=env, steps=steps))
    assert all(float(value) < 0.3 for value in measured.values())


def _features(
    position: np.ndarray,
    before: np.ndarray,
    columns: np.ndarray,
    sliding: Sequence[float] = (0.0, 0.0),
):
    """[272] of bodies at positions [15, 3] now and then, one turn for all [6]."""
    turn = np.broadcast_to(columns, (15, 6))
    velocity = (position - before) / DT
    bodies = np.concatenate([position, velocity, turn, np.zeros((15, 6))], 1).ravel()
    return seen(jnp.array(bodies), jnp.array(sliding), WEIGHTS)


def test_pair_moved_as_a_whole_is_as_far_away():
    rng = np.random.default_rng(1)
    at, turn = rng.normal(size=(15, 3)), rng.normal(size=6)
    here = _features(at, at, turn)
    moved = at + np.array([0.0, 0.03, 0.04])
    aside = _features(moved, moved, turn)
    gap = pair_coordinates(here, here, WEIGHTS) - pair_coordinates(
        aside, aside, WEIGHTS
    )
    assert gap.shape == (225,)
    assert float(jnp.linalg.norm(gap)) == pytest.approx(0.05, rel=1e-4)


def test_speed_and_turn_count_as_the_constants_say():
    at, turn = np.zeros((15, 3)), np.zeros(6)
    rest = _features(at, at, turn)
    moving = _features(at, at - [DT, 0.0, 0.0], turn)  # 1 m/s
    turned = _features(at, at, np.eye(6)[0])
    standing = pair_coordinates(rest, rest, WEIGHTS)
    for pair, expected in (
        ((rest, moving), VELOCITY_TIME),
        ((moving, rest), VELOCITY_TIME),
        ((rest, turned), COLUMN_ARM),
    ):
        gap = pair_coordinates(*pair, WEIGHTS) - standing
        assert float(jnp.linalg.norm(gap)) == pytest.approx(expected, rel=1e-4)


def test_velocities_and_turns_weigh_as_much_as_the_ways_they_make():
    bodies = np.ones((2, 15, 18), np.float32)
    values = np.asarray(weighed(jnp.array(bodies.reshape(2, 270)), WEIGHTS))
    pos, velocity, columns, rate = np.split(
        values.reshape(2, 15, 18), [3, 6, 12], axis=2
    )
    assert np.all(pos == 1.0)
    np.testing.assert_allclose(velocity, 0.05)
    np.testing.assert_allclose(columns, 0.3)
    np.testing.assert_allclose(rate, 0.3 * 0.05)


def test_sliding_soles_are_seen_and_are_no_distance():
    at, turn = np.zeros((15, 3)), np.zeros(6)
    still, slides = _features(at, at, turn), _features(at, at, turn, (0.2, 0.1))
    np.testing.assert_allclose(slides - still, [*[0.0] * 270, 0.2, 0.1], atol=1e-7)
    one = pair_coordinates(still, still, WEIGHTS)
    np.testing.assert_array_equal(pair_coordinates(slides, slides, WEIGHTS), one)


def test_floor_is_the_distance_of_other_pairs_of_the_clips(reference):
    floor = style.floor(Toy(), reference, 400)
    other = jnp.mean(style.nearest(reference, _clip_pairs(7, 400)))
    assert float(floor) == pytest.approx(float(other), rel=0.2)
    assert float(floor) > 1e-3
