"""Running moments against numpy."""

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.learn import normalizer


def test_moments_of_batches_are_those_of_all_samples():
    rng = np.random.default_rng(0)
    batches = [
        (rng.normal(size=(n, 3)) * [1, 5, 0.1] + [0, n, -2]).astype(np.float32)
        for n in (4, 100, 33)
    ]
    n = normalizer.moments(jnp.asarray(batches[0]))
    for batch in batches[1:]:
        n = normalizer.merge(n, normalizer.moments(jnp.asarray(batch)))
    everything = np.concatenate(batches).astype(np.float64)
    assert n.count == len(everything)
    np.testing.assert_allclose(n.mean, everything.mean(axis=0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(n.variance, everything.var(axis=0), rtol=1e-4)


def test_variance_survives_a_large_offset_in_float32():
    rng = np.random.default_rng(1)
    samples = (1e4 + rng.normal(size=(50, 256, 1))).astype(np.float32)
    n = normalizer.moments(jnp.asarray(samples[0]))
    for batch in samples[1:]:
        n = normalizer.merge(n, normalizer.moments(jnp.asarray(batch)))
    np.testing.assert_allclose(n.variance, samples.astype(np.float64).var(), rtol=2e-2)


def test_moments_of_equal_parts_are_those_of_all_samples():
    x = np.random.default_rng(3).normal([0, 50], [1, 2], size=(3, 200, 2))
    parts = jax.vmap(normalizer.moments)(jnp.asarray(x, jnp.float32))
    n = normalizer.pooled(parts)
    everything = x.reshape(-1, 2)
    assert n.count == 600
    np.testing.assert_allclose(n.mean, everything.mean(axis=0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(n.variance, everything.var(axis=0), rtol=1e-4)


def test_normalized_data_has_zero_mean_and_unit_spread():
    x = jnp.asarray(np.random.default_rng(2).normal(3.0, 2.0, size=(1000, 2)))
    z = normalizer.normalize(normalizer.moments(x), x)
    np.testing.assert_allclose(jnp.mean(z, axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(jnp.std(z, axis=0), 1.0, rtol=1e-3)


def test_constant_entry_neither_divides_by_zero_nor_explodes():
    n = normalizer.moments(jnp.full((8, 1), 2.0))
    assert normalizer.normalize(n, jnp.array([2.0])) == 0.0
    np.testing.assert_allclose(normalizer.normalize(n, jnp.array([2.01])), 1.0, 1e-3)
    assert normalizer.normalize(n, jnp.array([1e6])) == normalizer.CLIP
