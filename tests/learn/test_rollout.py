"""Episodes within a rollout: nothing leaks across a reset."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.learn import normalizer, ppo, rollout
from toy import Toy

ENVS, STEPS = 8, 30
CONFIG = ppo.PpoConfig(hidden=(8,), sigma_degrees=20.0)


def _actors(env: Toy) -> rollout.Actors:
    agent = ppo.init_agent(
        jax.random.key(0), env.observation_size, env.action_size, CONFIG
    )
    moments = normalizer.Normalizer(
        count=jnp.array(1.0), mean=jnp.zeros(3), variance=jnp.ones(3)
    )
    return rollout.Actors(
        policy=rollout.Policy(params=agent.policy.params, normalizer=moments),
        value=agent.value.params,
        alpha=None,
    )


@pytest.fixture(scope="module")
def taken() -> tuple[rollout.Actors, rollout.Rollout]:
    """Walls and a clock that end episodes both ways within 30 steps."""
    return _taken(chunk=4)


def _taken(chunk: int | None, span: int = 1) -> tuple[rollout.Actors, rollout.Rollout]:
    env = Toy(wall=1.5, horizon=7)
    actors = _actors(env)
    keys = jax.random.split(jax.random.key(1), ENVS)

    def run(key: jax.Array) -> rollout.Rollout:
        running = rollout.reset_all(keys, env, None, span)
        return rollout.rollout(key, env, actors, running, STEPS, CONFIG, chunk)

    return actors, jax.jit(run)(jax.random.key(2))


def test_size_of_a_chunk_changes_no_number(taken):
    whole = _taken(chunk=None)[1]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5),
        (taken[1].transitions, taken[1].env_metrics, taken[1].running),
        (whole.transitions, whole.env_metrics, whole.running),
    )


def test_chunks_come_back_in_time_and_environment_order(taken):
    transitions = taken[1].transitions
    assert transitions.obs.shape == (STEPS, ENVS, 3)
    # Within an episode the observation of the next step is where this one went.
    goes_on = ~(transitions.terminated | transitions.truncated)[:-1]
    went = transitions.pairs.s_next[:-1][goes_on]
    np.testing.assert_array_equal(went, transitions.obs[1:, :, :2][goes_on])


def test_both_endings_occur_and_start_a_new_episode(taken):
    transitions = taken[1].transitions
    ends = np.asarray(transitions.terminated | transitions.truncated)
    assert transitions.terminated.any() and transitions.truncated.any()
    fresh = np.asarray(transitions.obs[1:, :, :2])[ends[:-1]]
    assert np.abs(fresh).max() <= 1.0  # drawn by reset, inside the walls
    was = np.asarray(transitions.pairs.s_next)[:-1][ends[:-1]]
    assert np.abs(fresh - was).max(axis=1).min() > 1e-3


def test_pair_of_the_discriminator_never_straddles_a_reset(taken):
    transitions = taken[1].transitions
    # s is always where the step began, also in the step after a reset ...
    np.testing.assert_array_equal(transitions.pairs.s, transitions.obs[..., :2])
    # ... and s' where it ended, before the reset: beyond the wall where it fell.
    fell = np.asarray(transitions.pairs.s_next)[np.asarray(transitions.terminated)]
    assert (np.abs(fell).max(axis=1) > 1.5).all()


@pytest.mark.parametrize("chunk", [4, None])
def test_a_wider_pair_reaches_back_within_its_episode(taken, chunk):
    near, wide = taken[1].transitions, _taken(chunk, span=4)[1].transitions
    np.testing.assert_allclose(wide.obs, near.obs, atol=2e-5)
    np.testing.assert_allclose(wide.pairs.s_next, near.pairs.s_next, atol=2e-5)
    assert (np.asarray(near.span) == 1).all()
    ends = np.asarray(wide.terminated | wide.truncated)
    for b in range(ENVS):
        age = 0
        for t in range(STEPS):
            age += 1
            span = min(age, 4)
            assert wide.span[t, b] == span
            # What was observed before the first of the steps between.
            began = wide.obs[t - span + 1, b, :2]
            np.testing.assert_array_equal(wide.pairs.s[t, b], began)
            age = 0 if ends[t, b] else age


def test_length_counts_the_steps_of_the_episode(taken):
    transitions = taken[1].transitions
    lengths = np.asarray(transitions.length)
    ends = np.asarray(transitions.terminated | transitions.truncated)
    assert (lengths[~ends] == 0).all()
    for b in range(ENVS):
        at = np.flatnonzero(ends[:, b])
        np.testing.assert_array_equal(lengths[at, b], np.diff(at, prepend=-1))
    truncated = np.asarray(transitions.truncated)
    assert (lengths[truncated] == 7).all()


def test_final_value_is_that_of_the_state_before_the_reset(taken):
    actors, result = taken
    transitions = result.transitions
    truncated = np.asarray(transitions.truncated)
    assert not np.asarray(transitions.final_value)[~truncated].any()
    where = np.asarray(transitions.pairs.s_next)[truncated]
    obs = jnp.asarray(np.pad(where, ((0, 0), (0, 1))))
    seen = normalizer.normalize(actors.policy.normalizer, obs)
    expected = ppo.value_of(actors.value, seen, CONFIG.discount)
    np.testing.assert_allclose(
        np.asarray(transitions.final_value)[truncated], expected, rtol=1e-4, atol=1e-4
    )


def test_log_prob_is_of_the_action_taken(taken):
    actors, result = taken
    transitions = result.transitions
    mean = actors.policy.mean(transitions.obs)
    expected = ppo.log_prob(mean, transitions.action, CONFIG.sigma)
    np.testing.assert_allclose(transitions.log_prob, expected, rtol=1e-3, atol=1e-3)
    spread = np.std(np.asarray(transitions.action - mean))
    np.testing.assert_allclose(spread, CONFIG.sigma, rtol=0.1)


def test_broken_environment_is_kept_as_it_was_before():
    env = Toy(poisoned=True)
    actors = _actors(env)
    running = rollout.reset_all(jax.random.split(jax.random.key(1), ENVS), env, None)
    result = jax.jit(
        lambda key: rollout.rollout(key, env, actors, running, STEPS, CONFIG)
    )(jax.random.key(3))
    nan = np.asarray(result.transitions.nan)
    assert nan.any() and bool(result.incident.happened)
    t = np.nonzero(nan)[0][-1]
    first = np.flatnonzero(nan[t])[0]
    np.testing.assert_array_equal(
        result.incident.env.obs, result.transitions.obs[t, first]
    )
    np.testing.assert_array_equal(
        result.incident.action, result.transitions.action[t, first]
    )
    # Observation and action belong together: the policy that acted says how likely.
    mean = actors.policy.mean(result.incident.env.obs)
    np.testing.assert_allclose(
        ppo.log_prob(mean, result.incident.action, CONFIG.sigma),
        result.transitions.log_prob[t, first],
        rtol=1e-3,
    )
