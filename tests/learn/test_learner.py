"""The whole update on the toy: it learns, repeats itself, and is traced once."""

import dataclasses

import jax
import numpy as np
import pytest

from dcc_jax.learn import learner
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.state import TrainConfig
from dcc_jax.learn.update import chunk_size
from toy import ToyConfig


def _rewards(compiled, seed: int, updates: int) -> list[float]:
    state = compiled.init(jax.random.key(seed), None)
    rewards = []
    for _ in range(updates):
        state, report = compiled.update(state)
        rewards.append(float(report.metrics["reward/r_p"]))
    return rewards


def test_point_learns_to_run_home(compiled):
    rewards = _rewards(compiled, seed=0, updates=40)
    assert rewards[0] < 0.35
    assert np.mean(rewards[-5:]) > 0.65


def test_same_seed_gives_the_same_numbers_and_another_does_not(compiled):
    once, again, other = (_rewards(compiled, seed, 3) for seed in (1, 1, 2))
    assert once == again
    assert once != other


def test_update_is_traced_once(compiled, first_state):
    # The fixture's update raises when it is traced a second time.
    state, _ = compiled.update(first_state)
    host = jax.device_get(state)
    shardings = learner.state_shardings(compiled.mesh, host)
    restored = jax.device_put(host, shardings)
    for _ in range(2):
        restored, _ = compiled.update(restored)
    assert int(restored.update) == 3
    assert compiled.traces() == 1


def test_donated_state_is_gone(compiled, first_state):
    compiled.update(first_state)
    assert first_state.agent.policy.params.layers[0].kernel.is_deleted()


def test_policy_that_a_run_gives_is_a_mean_over_updates(compiled, first_state):
    count = compiled.config.train.averaged_updates
    assert count == 3
    state, kernel, expected = first_state, np.zeros(()), np.zeros(())
    for update in range(1, 6):
        state, _ = compiled.update(state)
        kernel = np.asarray(state.agent.policy.params.layers[0].kernel)
        share = 1.0 / min(update, count)
        expected = (1.0 - share) * expected + share * kernel
        found = state.averaged.layers[0].kernel
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)
    assert np.abs(kernel - expected).max() > 1e-4


def test_parameters_are_the_same_on_every_device(compiled, first_state):
    state, _ = compiled.update(first_state)
    for leaf in jax.tree.leaves(
        (state.agent, state.averaged, state.disc, state.obs_normalizer)
    ):
        shards = [np.asarray(shard.data) for shard in leaf.addressable_shards]
        for shard in shards[1:]:
            np.testing.assert_array_equal(shard, shards[0])
    assert state.running.env.obs.shape[0] == compiled.config.train.num_envs


def test_environments_of_two_devices_differ(compiled, first_state):
    obs = np.asarray(first_state.running.env.obs)
    assert len(np.unique(obs[:, 0])) == len(obs)


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        ("ppo", {"minibatch_size": 100}, r"must divide the 512 .* a multiple of 50;"),
        ("disc", {"minibatch_size": 7}, r"disc\.minibatch_size must be a multiple"),
        ("train", {"chunk_size": 3}, r"train\.chunk_size must divide the 16"),
    ],
)
def test_sizes_that_do_not_come_out_even_are_named(section, values, message):
    config = ToyConfig()
    part = dataclasses.replace(getattr(config, section), **values)
    with pytest.raises(ValueError, match=message):
        learner.check_sizes(dataclasses.replace(config, **{section: part}), devices=2)


@pytest.mark.parametrize(
    ("environments", "chunk"),
    [(16, 16), (128, 128), (200, 100), (4096, 128), (257, 257)],
)
def test_a_cpu_steps_as_many_at_once_as_come_out_even(environments, chunk):
    if jax.default_backend() != "cpu":
        pytest.skip("elsewhere all are stepped at once")
    assert chunk_size(TrainConfig(), environments) == chunk


def test_environments_that_devices_cannot_share_are_refused():
    count = len(jax.devices())
    if count == 1:
        pytest.skip("one device shares any number of environments")
    with pytest.raises(ValueError, match=r"train\.num_envs must be a multiple"):
        learner.make_mesh(TrainConfig(num_envs=count * 4 + 1))


def test_no_environments_are_refused():
    with pytest.raises(ValueError, match=r"train\.num_envs must be 1 or more, got 0"):
        TrainConfig(num_envs=0)


def test_fixed_sigma_is_six_degrees():
    np.testing.assert_allclose(PpoConfig().sigma, np.deg2rad(6.0))
