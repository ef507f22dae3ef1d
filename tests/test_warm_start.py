"""The policy's first lesson: what leads along the clips."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import quat, tasks
from dcc_jax.config import make_config
from dcc_jax.env.environment import Environment
from dcc_jax.learn import learner
from dcc_jax.learn.rollout import Policy
from dcc_jax.learn.state import TrainConfig, TrainState
from toy import Toy, ToyConfig


def _begun(steps: int, devices: int) -> TrainState:
    config = ToyConfig()
    train = dataclasses.replace(config.train, warm_start_steps=steps)
    config = dataclasses.replace(config, train=train)
    mesh = learner.make_mesh(config.train, devices)
    return learner.make_init(Toy(), config, mesh)(jax.random.key(0), None)


def _error(state: TrainState) -> float:
    begun = jax.vmap(Toy().reset)(jax.random.split(jax.random.key(7), 99))
    action = jax.vmap(Toy().expert_action)(begun)
    policy = Policy(state.agent.policy.params, state.obs_normalizer)
    return float(jnp.sqrt(jnp.mean((policy.mean(begun.obs) - action) ** 2)))


@pytest.mark.parametrize("devices", [1, 2])
def test_policy_begins_with_what_was_demonstrated(devices):
    if devices > len(jax.devices()):
        pytest.skip("one device")
    assert _error(_begun(0, devices)) > 0.2
    assert _error(_begun(300, devices)) < 0.02


def test_optimiser_forgets_the_lesson():
    cold, warm = _begun(0, 1), _begun(5, 1)
    for before, after in zip(
        jax.tree.leaves(cold.agent.policy.opt_state),
        jax.tree.leaves(warm.agent.policy.opt_state),
        strict=True,
    ):
        np.testing.assert_array_equal(before, after)


def test_negative_steps_are_refused():
    with pytest.raises(ValueError, match="warm_start_steps must be 0 or more, got -1"):
        TrainConfig(warm_start_steps=-1)
    with pytest.raises(ValueError, match=r"policy_waits must be less than 2\^31"):
        TrainConfig(policy_waits=10**12)


@pytest.fixture(scope="module", params=["trampoline", "door"])
def environment(request) -> Environment:
    config = make_config(request.param)
    return tasks.make_environment(config.task, config.env)


def test_demonstration_asks_for_the_pose_a_little_later(environment):
    state = environment.reset(jax.random.key(3))
    action = environment.expert_action(state)
    at = state.reference
    # The mean over the joints of kv / kp = 2 / sqrt(kp), kp 300 to 500, and dt / 2.
    lead = environment.expert_lead
    assert 2 / np.sqrt(500) < lead - 1 / 60 < 2 / np.sqrt(300)
    _, plan = environment.begin(jax.random.key(4), state, action)
    coords = environment.kinematics.coords
    _, asked = coords.split_q(plan.pose)
    _, wanted = coords.split_q(environment.references.qpos_at(at.clip, at.time + lead))
    apart = quat.log(quat.mul(quat.inv(asked), wanted))[1:]
    np.testing.assert_allclose(apart, 0.0, atol=2e-6)
