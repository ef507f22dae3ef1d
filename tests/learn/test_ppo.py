"""GAE and the losses of PPO, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from dcc_jax.learn import networks, ppo

G, L = 0.9, 0.5


def _gae(terminated: list[bool], truncated: list[bool]) -> np.ndarray:
    column = lambda x: jnp.asarray(x)[:, None]  # noqa: E731
    return np.asarray(
        ppo.gae(
            rewards=column([1.0, 2.0, 3.0]),
            values=column([10.0, 20.0, 30.0]),
            next_values=column([20.0, 30.0, 40.0]),
            terminated=column(terminated),
            truncated=column(truncated),
            discount=G,
            gae_lambda=L,
        )
    )[:, 0]


# delta = r + 0.9 V' - V of the three steps, when every V' counts: 9, 9, 9.
def test_gae_within_one_episode():
    # A_2 = 9, A_1 = 9 + 0.45 * 9, A_0 = 9 + 0.45 * A_1.
    expected = [9 + 0.45 * 13.05, 13.05, 9.0]
    np.testing.assert_allclose(_gae([False] * 3, [False] * 3), expected, rtol=1e-6)


def test_gae_takes_no_value_after_a_termination():
    # delta_1 = 2 - 20; nothing of A_2 reaches it.
    expected = [9 + 0.45 * -18.0, -18.0, 9.0]
    result = _gae([False, True, False], [False] * 3)
    np.testing.assert_allclose(result, expected, rtol=1e-6)


def test_gae_keeps_the_value_of_a_truncated_state_but_stops_there():
    expected = [9 + 0.45 * 9.0, 9.0, 9.0]
    result = _gae([False] * 3, [False, True, False])
    np.testing.assert_allclose(result, expected, rtol=1e-6)


def test_termination_wins_where_both_happen():
    np.testing.assert_array_equal(
        _gae([False, True, False], [False, True, False]),
        _gae([False, True, False], [False] * 3),
    )


def test_log_prob_is_that_of_scipy():
    mean, action = np.array([0.1, -0.2]), np.array([0.3, 0.0])
    expected = scipy.stats.norm(mean, 0.1).logpdf(action).sum()
    result = ppo.log_prob(jnp.asarray(mean), jnp.asarray(action), 0.1)
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def _constant(value: float) -> networks.Mlp:
    """A network whose output is `value` whatever it sees."""
    return networks.Mlp((networks.Layer(jnp.zeros((1, 1)), jnp.array([value])),))


def _batch(config: ppo.PpoConfig, advantage: float, ratio: float) -> ppo.Batch:
    now = ppo.log_prob(jnp.zeros((1, 1)), jnp.zeros((1, 1)), config.sigma)
    return ppo.Batch(
        obs=jnp.zeros((1, 1)),
        action=jnp.zeros((1, 1)),
        log_prob=now - jnp.log(ratio),
        advantage=jnp.array([advantage]),
        target=jnp.array([7.0]),
    )


@pytest.mark.parametrize(
    ("advantage", "ratio", "gain"),
    [
        (2.0, 1.1, 2.2),  # inside
        (2.0, 1.5, 2.4),  # a gain is cut at 1.2
        (2.0, 0.5, 1.0),  # a loss of a good action is not
        (-2.0, 0.5, -1.6),  # cut at 0.8
        (-2.0, 1.5, -3.0),  # a bad action made likelier is not
    ],
)
def test_surrogate_is_clipped_on_the_side_of_the_gain(advantage, ratio, gain):
    config = ppo.PpoConfig(clip=0.2)
    batch = _batch(config, advantage, ratio)
    loss, metrics = ppo.policy_loss(_constant(0.0), batch, config)
    np.testing.assert_allclose(loss, -gain, rtol=1e-4)
    assert metrics["ppo/clip_fraction"] == float(abs(ratio - 1) > 0.2)
    np.testing.assert_allclose(
        metrics["ppo/kl"], ratio - 1 - np.log(ratio), rtol=1e-3, atol=1e-5
    )


def test_value_is_in_units_of_the_longest_return():
    config = ppo.PpoConfig(discount=0.95)
    value = ppo.value_of(_constant(0.25), jnp.zeros((1, 1)), 0.95)
    np.testing.assert_allclose(value, 5.0, rtol=1e-6)
    # Half of ((5 - 7) / 20)^2.
    loss, _ = ppo.value_loss(_constant(0.25), _batch(config, 0.0, 1.0), config)
    np.testing.assert_allclose(loss, 0.005, rtol=1e-5)


def test_first_policy_hardly_offsets_the_pose():
    agent = ppo.init_agent(jax.random.key(0), 20, 6, ppo.PpoConfig(hidden=(32, 32)))
    obs = jax.random.normal(jax.random.key(1), (100, 20))
    mean = networks.apply_mlp(agent.policy.params, obs)
    assert jnp.max(jnp.abs(mean)) < 0.1  # rad
    assert jnp.std(mean) > 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("clip", 0.0),
        ("discount", 1.5),
        ("epochs", 0),
        ("hidden", (0,)),
        ("activation", "sine"),
    ],
)
def test_value_out_of_range_is_named(name, value):
    with pytest.raises(ValueError, match=rf"ppo\.{name} must be .*, got"):
        ppo.PpoConfig(**{name: value})
