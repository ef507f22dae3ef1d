"""Networks and their optimiser step against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.learn import networks


def test_layers_are_xavier_uniform_with_zero_bias():
    network = networks.init_mlp(jax.random.key(0), (50, 40, 30), output_gain=0.5)
    for layer, gain in zip(network.layers, (1.0, 0.5), strict=True):
        bound = gain * np.sqrt(6.0 / sum(layer.kernel.shape))
        kernel = np.asarray(layer.kernel)
        assert np.abs(kernel).max() <= bound
        # The variance of a uniform distribution is its bound squared over three.
        np.testing.assert_allclose(kernel.std(), bound / np.sqrt(3), rtol=0.1)
        assert not np.any(layer.bias)


@pytest.mark.parametrize(
    ("activation", "expected"),
    [
        ("relu", lambda x: np.maximum(x, 0)),
        ("leaky_relu", lambda x: np.maximum(x, 0.01 * x)),
        ("elu", lambda x: np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)),
        ("silu", lambda x: x / (1 + np.exp(-x))),
        ("tanh", np.tanh),
    ],
)
def test_network_is_nonlinear_between_affine_maps(activation, expected):
    rng = np.random.default_rng(0)
    W1, b1, W2, b2 = (
        rng.normal(size=s).astype(np.float32) for s in [(3, 4), 4, (4, 2), 2]
    )
    x = rng.normal(size=(5, 3)).astype(np.float32)
    layers = (networks.Layer(W1, b1), networks.Layer(W2, b2))
    network = networks.Mlp(layers, activation)
    np.testing.assert_allclose(
        networks.apply_mlp(network, x), expected(x @ W1 + b1) @ W2 + b2, atol=1e-5
    )


def _network() -> tuple[networks.Network, object]:
    optimizer = networks.clipped_adam(1.0)
    layers = (networks.Layer(jnp.ones((2, 1)), jnp.zeros(1)),)
    return networks.init_network(networks.Mlp(layers), optimizer), optimizer


def test_first_adam_step_has_the_length_of_the_rate():
    network, optimizer = _network()
    slope = networks.Layer(jnp.array([[0.3], [-0.4]]), jnp.array([0.0]))
    gradient = networks.Mlp((slope,))
    after, skipped = networks.apply_gradients(network, gradient, 0.01, optimizer)
    assert skipped == 0.0
    step = after.params.layers[0].kernel - network.params.layers[0].kernel
    np.testing.assert_allclose(step[:, 0], [-0.01, 0.01], rtol=1e-3)


def test_gradient_that_is_not_finite_changes_nothing_and_is_counted():
    network, optimizer = _network()
    for bad in (jnp.nan, jnp.inf):
        slope = networks.Layer(jnp.array([[1.0], [bad]]), jnp.array([1.0]))
        gradient = networks.Mlp((slope,))
        after, skipped = networks.apply_gradients(network, gradient, 0.01, optimizer)
        assert skipped == 1.0
        same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), after, network)
        assert all(jax.tree.leaves(same))
