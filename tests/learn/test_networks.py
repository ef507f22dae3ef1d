"""Networks and their optimiser step against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
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


RATE = 0.01
OPTIMIZERS = [networks.clipped_adam(RATE, 1.0), networks.adjustable_adam(RATE, 1.0)]


def _layer(kernel: list[float], bias: float) -> networks.Mlp:
    layer = networks.Layer(jnp.array(kernel)[:, None], jnp.array([bias]))
    return networks.Mlp((layer,))


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_first_adam_step_has_the_length_of_the_rate(optimizer):
    network = networks.init_network(_layer([1.0, 1.0], 0.0), optimizer)
    gradient = _layer([0.3, -0.4], 0.0)
    after, skipped = networks.apply_gradients(network, gradient, optimizer)
    assert skipped == 0.0
    step = after.params.layers[0].kernel - network.params.layers[0].kernel
    np.testing.assert_allclose(step[:, 0], [-RATE, RATE], rtol=1e-3)


def test_long_gradient_is_scaled_down_to_the_norm():
    optimizer = networks.clipped_adam(RATE, max_norm=1.0)
    network = networks.init_network(_layer([1.0, 1.0], 0.0), optimizer)
    after, _ = networks.apply_gradients(network, _layer([30.0, -40.0], 0.0), optimizer)
    # Adam's mean is a tenth of its first gradient: 0.1 (0.6, -0.8).
    mean = optax.tree.get(after.opt_state, "mu")
    np.testing.assert_allclose(np.sort(mean), [-0.08, 0.0, 0.06], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_gradient_that_is_not_finite_changes_nothing_and_is_counted(bad, optimizer):
    network = networks.init_network(_layer([1.0, 1.0], 0.0), optimizer)
    good, _ = networks.apply_gradients(network, _layer([0.3, -0.4], 0.1), optimizer)
    after, skipped = networks.apply_gradients(good, _layer([1.0, bad], 1.0), optimizer)
    assert skipped == 1.0
    adam = after.opt_state.inner_state, good.opt_state.inner_state
    assert len(jax.tree.leaves(adam[0])) > 2
    jax.tree.map(np.testing.assert_array_equal, after.params, good.params)
    jax.tree.map(np.testing.assert_array_equal, *adam)


def test_step_follows_a_rate_that_was_changed():
    optimizer = networks.adjustable_adam(RATE, 1.0)
    network = networks.init_network(_layer([1.0, 1.0], 0.0), optimizer)
    network = networks.with_learning_rate(network, jnp.array(0.5))
    assert networks.learning_rate(network) == 0.5
    after, _ = networks.apply_gradients(network, _layer([0.3, -0.4], 0.0), optimizer)
    np.testing.assert_allclose(after.params.layers[0].kernel[:, 0], [0.5, 1.5], 1e-3)
