"""rewards.py against numbers worked out by hand."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.env import rewards

CONFIG = rewards.RewardConfig()


def test_pose_reward_by_hand():
    d = jnp.array([1.0, 0.0, -1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        rewards.pose_reward(d, CONFIG), [1.0, 0.8, 0.2, 0.8, 0.2], atol=1e-6
    )
    large = rewards.RewardConfig(beta=0.25)
    np.testing.assert_allclose(rewards.pose_reward(d, large)[2], 0.0, atol=1e-6)


def test_pose_reward_is_never_negative():
    d = jnp.array([-10.0, 10.0])
    np.testing.assert_array_equal(rewards.pose_reward(d, CONFIG), [0.0, 0.0])


def test_position_reward_by_hand():
    p, v = jnp.array([1.0, 2.0, 0.9]), jnp.array([0.5, 0.0, 0.0])
    u_p, ud_p = jnp.array([1.0, 1.0, 0.9]), jnp.array([0.0, 0.0, -1.0])
    expected = 0.7 * math.exp(-0.5) + 0.3 * math.exp(-1.25)
    np.testing.assert_allclose(
        rewards.position_reward(p, v, u_p, ud_p, CONFIG), expected, rtol=1e-6
    )


def test_position_reward_is_one_where_the_root_follows_its_displacement():
    p = jnp.ones((4, 3))
    r_p = rewards.position_reward(p, 2 * p, p, 2 * p, CONFIG)
    np.testing.assert_allclose(r_p, np.ones(4), rtol=1e-6)


def test_reward_by_hand():
    r_q, r_p, r_task = jnp.array(0.8), jnp.array(0.5), jnp.array(0.3)
    np.testing.assert_allclose(rewards.reward(r_q, r_p, CONFIG), 0.4, rtol=1e-6)
    np.testing.assert_allclose(
        rewards.reward(r_q, r_p, CONFIG, r_task), 0.35, rtol=1e-6
    )


@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan])
def test_a_bad_weight_is_refused_by_name(value):
    with pytest.raises(ValueError, match="sigma_v"):
        rewards.RewardConfig(sigma_v=value)


def test_tracking_reward_falls_with_the_squared_angles_of_all_joints():
    error = jnp.zeros((2, 13, 3)).at[1, 4].set(jnp.array([0.3, 0.0, 0.4]))
    error = error.at[1, 0, 2].set(0.5)
    tracked = rewards.tracking_reward(error, CONFIG)
    np.testing.assert_allclose(tracked, [1.0, np.exp(-2.0 * 0.5)], rtol=1e-6)
