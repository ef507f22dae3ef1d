"""What r_q is: the discriminator's score or the distance to the reference's pose."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcc_jax import config, quat, tasks
from dcc_jax.character import CONTROL_DT
from dcc_jax.env.observation import ALPHA_ENTRY, PHASE_SIZE, POSE_SIZE
from dcc_jax.play import runs
from dcc_jax.play.runs import find_run

PHASE = slice(ALPHA_ENTRY + 1, ALPHA_ENTRY + 1 + PHASE_SIZE)
POSE = slice(PHASE.stop, PHASE.stop + POSE_SIZE)


def make(task: str, imitation: str):
    run = config.make_config(task, "smoke").with_({"env.imitation": imitation})
    return tasks.make_environment(run.task, run.env)


@pytest.mark.parametrize(
    ("task", "imitation", "tracks", "follows", "condition"),
    [
        ("push", "task", False, False, 0),
        ("push", "tracking", True, True, 0),
        ("door", "task", True, True, 0),
        ("door", "adversarial", False, True, PHASE_SIZE),
        ("hand-in-hand", "task", True, True, 0),
        ("hand-in-hand", "adversarial", False, True, 0),
        ("sustained-push", "task", False, True, 0),
        ("sustained-push", "tracking", True, True, 0),
    ],
)
def test_a_setting_says_who_judges(task, imitation, tracks, follows, condition):
    environment = make(task, imitation)
    assert environment.tracks_reference == tracks
    assert environment.follows_reference == follows
    assert environment.condition_size == condition
    assert environment.has_phase == (tracks or condition > 0)


@pytest.fixture(scope="module")
def door():
    """A door whose discriminator is given the phase: its environment, three states."""
    environment = make("door", "adversarial")
    state = jax.jit(environment.reset)(jax.random.key(2))
    step = jax.jit(environment.step)
    action, states = jnp.zeros(environment.action_size), [state]
    for key in jax.random.split(jax.random.key(3)):
        states.append(step(key, states[-1], action))
    return environment, states


def test_the_discriminator_is_given_the_phase_that_the_policy_observes(door):
    environment, states = door
    for state in states:
        assert state.obs.shape == (environment.observation_size,)
        np.testing.assert_array_equal(state.condition, state.obs[PHASE])
    phases = [float(state.reference.phase) for state in states]
    assert phases[0] < phases[1] < phases[2]
    np.testing.assert_allclose(states[-1].condition[0], phases[-1])


def test_the_policy_observes_the_pose_that_its_action_is_an_offset_from():
    """Against scipy: the pose one control step ahead, from the nominal one; its root
    from the character's."""
    environment = make("door", "tracking")
    state = jax.jit(environment.reset)(jax.random.key(2))
    observed = jax.jit(environment.observed)
    tilt = jnp.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0])  # 0.2 rad about y
    q = environment.scene.character_qpos(state.body.qpos)
    assert environment.scene.qpos_adr == 0
    qpos = state.body.qpos.at[3:7].set(quat.mul(q[3:7], tilt))
    body = dataclasses.replace(state.body, qpos=qpos)
    seen = np.asarray(observed(dataclasses.replace(state, body=body)).obs[POSE])
    ahead = environment.references.qpos_at(0, state.reference.time + CONTROL_DT)
    assert seen[0] == pytest.approx(float(ahead[2]), abs=1e-6)

    def turns(pose):
        quats = np.asarray(pose)[3:].reshape(13, 4)
        return Rotation.from_quat(quats, scalar_first=True)

    joints = turns(environment.nominal)[1:].inv() * turns(ahead)[1:]
    np.testing.assert_allclose(seen[4:], joints.as_rotvec().ravel(), atol=1e-5)
    assert np.abs(seen[4:]).max() > 0.1
    root = turns(qpos[: q.size])[0].inv() * turns(ahead)[0]
    np.testing.assert_allclose(seen[1:4], root.as_rotvec(), atol=1e-5)
    assert seen[2] == pytest.approx(-0.2, abs=0.02)


def test_the_paper_observes_the_phase_alone():
    with_pose = make("door", "tracking")
    run = config.make_config("door", "paper")
    assert not run.env.observe_reference
    alone = tasks.make_environment(run.task, run.env)
    assert with_pose.observation_size - alone.observation_size == POSE_SIZE
    assert not make("push", "task").has_pose


def test_the_clips_come_with_their_phase(door):
    """A pair that is late in the clip has its phase there: the pose tells the time."""
    environment, _ = door
    s, s_next, condition = jax.jit(environment.expert_pairs)(
        jax.random.key(0), jnp.ones(64, jnp.int32)
    )
    assert condition.shape == (64, PHASE_SIZE)
    turn = np.hypot(condition[:, 1], condition[:, 2])
    np.testing.assert_allclose(turn, 1.0, rtol=1e-5)
    clips = environment.references
    at = jax.vmap(lambda t: clips.phase_at(0, t))(
        jnp.linspace(0.0, clips.duration[0], 200)
    )
    assert float(jnp.min(condition[:, 0])) < 0.2 < 0.8 < float(jnp.max(condition[:, 0]))
    assert float(jnp.max(condition[:, 0])) <= float(at[-1])
    assert np.isfinite(s).all() and np.isfinite(s_next).all()


def test_an_action_is_from_the_nominal_pose_unless_the_reference_is_tracked(door):
    environment, states = door
    zero = jnp.zeros(environment.action_size)
    _, inputs = environment.begin(jax.random.key(0), states[0], zero)
    np.testing.assert_allclose(inputs.pose, environment.nominal, atol=1e-6)


def test_push_can_track_its_clip_in_time():
    environment = make("push", "tracking")
    state = jax.jit(environment.reset)(jax.random.key(0))
    action = jnp.zeros(environment.action_size)
    after = jax.jit(environment.step)(jax.random.key(1), state, action)
    assert after.reference.time > state.reference.time
    assert 0.95 < after.r_q <= 1.0, "it stands in its reference's pose"


def test_what_is_neither_is_refused():
    with pytest.raises(ValueError, match=r"imitation must be one of .*got 'copying'"):
        config.make_config("push").with_({"env.imitation": "copying"})


def test_a_policy_keeps_the_setting_it_was_trained_with():
    run = find_run("door")
    assert run.config.env.imitation == "task"
    assert runs.make_environment(run).tracks_reference
