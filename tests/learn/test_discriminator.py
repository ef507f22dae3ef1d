"""Eq. 12 and its penalties, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.learn import discriminator, networks, normalizer
from dcc_jax.learn.discriminator import DiscriminatorConfig

CONFIG = DiscriminatorConfig(gradient_penalty=3.0, logit_penalty=0.5)


def _linear() -> networks.Mlp:
    """D(x) = 3 x_0 + 4 x_1 + 1."""
    return networks.Mlp((networks.Layer(jnp.array([[3.0], [4.0]]), jnp.array([1.0])),))


def test_loss_of_a_linear_discriminator():
    expert = jnp.array([[0.0, 0.0], [1.0, 0.0]])  # D = 1, 4
    policy = jnp.array([[0.0, -0.5], [1.0, -1.0]])  # D = -1, 0
    total, metrics = discriminator.loss(_linear(), expert, policy, CONFIG)
    judged = discriminator.judged(_linear(), expert, policy)
    # ((1 - 1)^2 + (4 - 1)^2) / 2 + ((-1 + 1)^2 + (0 + 1)^2) / 2
    np.testing.assert_allclose(metrics["disc/loss"], 4.5 + 0.5)
    # 3 / 2 |(3, 4)|^2 + 0.5 |(3, 4)|^2
    np.testing.assert_allclose(total, 5.0 + 1.5 * 25.0 + 0.5 * 25.0)
    assert judged["disc/accuracy_real"] == 1.0
    assert judged["disc/accuracy_fake"] == 0.5
    np.testing.assert_allclose(judged["disc/margin"], 2.5 - -0.5)


def test_gradient_penalty_is_the_mean_squared_slope():
    # D(x) = relu(x) + 2 relu(-x): slope 1 on the right, -2 on the left.
    layers = (
        networks.Layer(jnp.array([[1.0, -1.0]]), jnp.zeros(2)),
        networks.Layer(jnp.array([[1.0], [2.0]]), jnp.zeros(1)),
    )
    x = jnp.array([[1.0], [2.0], [-1.0]])
    penalty = discriminator.gradient_penalty(networks.Mlp(layers), x)
    np.testing.assert_allclose(penalty, (1 + 1 + 4) / 3)


def test_inputs_normalize_the_features_and_leave_the_condition():
    n = normalizer.Normalizer(
        count=jnp.array(1.0), mean=jnp.array([1.0]), variance=jnp.array([4.0])
    )
    pairs = discriminator.Pairs(
        s=jnp.array([[3.0]]), s_next=jnp.array([[-1.0]]), condition=jnp.array([[7.0]])
    )
    seen = discriminator.inputs(n, pairs, CONFIG)
    np.testing.assert_allclose(seen, [[1.0, -1.0, 7.0]])


def test_a_still_feature_is_divided_by_the_floor():
    n = normalizer.Normalizer(jnp.array(1.0), jnp.zeros(1), jnp.array([1e-6]))
    pairs = discriminator.Pairs(
        jnp.array([[0.05]]), jnp.array([[0.1]]), jnp.ones((1, 0))
    )
    config = DiscriminatorConfig(feature_floor=0.1)
    np.testing.assert_allclose(discriminator.inputs(n, pairs, config), [[0.5, 1.0]])


def test_instance_noise_is_on_both_features_and_not_on_the_condition():
    x = jnp.ones((20_000, 3))  # s, s' and a condition
    noisy = discriminator.blurred(jax.random.key(0), x, 1, CONFIG)
    off = noisy - x
    np.testing.assert_array_equal(off[:, 2], 0.0)
    np.testing.assert_allclose(
        jnp.cov(off[:, :2].T), CONFIG.instance_noise**2 * np.eye(2), atol=4e-3
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [("minibatches", 0), ("hidden", (-1,)), ("span", 0), ("span", 1000)],
)
def test_value_out_of_range_is_named(name, value):
    with pytest.raises(ValueError, match=rf"disc\.{name} must be .*, got"):
        DiscriminatorConfig(**{name: value})


def test_equal_inputs_cannot_be_told_apart():
    x = jax.random.normal(jax.random.key(0), (10, 2))
    metrics = discriminator.judged(_linear(), x, x)
    total = metrics["disc/accuracy_real"] + metrics["disc/accuracy_fake"]
    np.testing.assert_allclose(total, 1.0)
