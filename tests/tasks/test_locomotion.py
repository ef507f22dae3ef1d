"""The command that goes on, and what the policy sees of it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import physics
from dcc_jax.character import CONTROL_DT, asset_path
from dcc_jax.config import make_config
from dcc_jax.env.task import RootTarget
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.paths import Gaits
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks import make_environment
from dcc_jax.tasks.locomotion import Locomotion

TASK = Locomotion(gaits=Gaits(speeds=(2.0,), leg_time=(0.01, 9.0), turn_rate=0.0))
STEPS = 90


@pytest.fixture(scope="module")
def stand():
    clip = load_clip(asset_path("motions/stand.npz"))
    return make_references([clip]).sample(jax.random.key(0), begin=True)


@pytest.fixture(scope="module")
def carried(scene, stand):
    """States and bodies of a root that is carried along the path, without lag."""
    state, qpos, qvel = TASK.reset(jax.random.key(1), scene, stand)
    states, bodies = [state], [physics.initial_state(scene, qpos, qvel)]
    step = jax.jit(lambda key, s, b: TASK.control_step(key, scene, s, b)[0])
    for key in jax.random.split(jax.random.key(2), STEPS):
        states.append(step(key, states[-1], bodies[-1]))
        here = states[-1].motion.position
        place = scene.qpos_adr
        qpos = qpos.at[place : place + 2].set(here)
        bodies.append(physics.initial_state(scene, qpos, qvel))
    return states, bodies


def test_it_comes_to_the_speed_that_is_wanted_and_no_faster_than_it_may(carried):
    states, _ = carried
    speed = np.array([state.motion.speed for state in states])
    assert speed[0] == 0.0 and speed[-1] == pytest.approx(2.0, abs=1e-4)
    gained = np.diff(speed) / CONTROL_DT
    assert gained.max() <= TASK.gaits.acceleration + 1e-3 and gained.min() >= -1e-3


def test_the_target_of_the_root_is_on_the_path_and_moves_as_it_does(scene, carried):
    states, _ = carried
    start = RootTarget(jnp.full(2, np.nan), jnp.full(2, np.nan))
    state = states[-1]
    now = state.motion.time
    first, later = (
        TASK.root_target(scene, state, start, now + t) for t in (0.0, CONTROL_DT)
    )
    moved = (later.position - first.position) / CONTROL_DT
    np.testing.assert_allclose(moved, first.velocity, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(first.velocity), 2.0, rtol=1e-4)


def test_who_stays_behind_is_waited_for(scene, carried):
    """The body stays at the origin, the path stays within the leash."""
    states, bodies = carried
    step = jax.jit(lambda key, s: TASK.control_step(key, scene, s, bodies[0])[0])
    state = states[-1]
    for key in jax.random.split(jax.random.key(3), 5):
        state = step(key, state)
    root = scene.character_qpos(bodies[0].qpos)[:2]
    away = np.linalg.norm(state.motion.position - root)
    assert away == pytest.approx(TASK.leash, rel=1e-5)


def test_what_is_seen_turns_with_the_character(scene, stand, carried):
    """The same world seen by who faces left: what was ahead is on the right."""
    states, bodies = carried
    body = bodies[-1]
    seen = np.array(TASK.observe(scene, states[-1], body)).reshape(3, 2)
    turn = jnp.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    place = scene.qpos_adr + 3
    q = body.qpos[place : place + 4]
    assert abs(float(q[0])) > 0.99, "it faces along x"
    turned = dataclasses.replace(body, qpos=body.qpos.at[place : place + 4].set(turn))
    other = np.array(TASK.observe(scene, states[-1], turned)).reshape(3, 2)
    expected = np.stack([seen[:, 1], -seen[:, 0]], axis=1)
    np.testing.assert_allclose(other, expected, atol=0.1)
    assert seen[1, 0] == pytest.approx(2.0, abs=0.05), "its velocity is ahead"


def test_its_numbers_are_those_of_the_root_along_the_path(scene, carried):
    states, bodies = carried
    place = scene.dof_adr
    ahead = states[-1].motion.heading
    sideways = 1.5 * jnp.stack([jnp.cos(ahead), jnp.sin(ahead)])
    sideways += 0.5 * jnp.stack([-jnp.sin(ahead), jnp.cos(ahead)])
    qvel = bodies[-1].qvel.at[place : place + 2].set(sideways)
    moving = dataclasses.replace(bodies[-1], qvel=qvel)
    numbers = TASK.evaluate(scene, states[-1], moving)
    assert float(numbers["speed_along"]) == pytest.approx(1.5, abs=1e-3)
    assert float(numbers["speed"]) == pytest.approx(np.hypot(1.5, 0.5), abs=1e-3)
    assert float(numbers["path_speed"]) == pytest.approx(2.0, abs=1e-3)


def test_tracking_is_refused_in_one_line():
    config = make_config("locomotion", "smoke").with_({"env.imitation": "tracking"})
    with pytest.raises(ValueError, match="must be 'adversarial' for task 'locomotion'"):
        make_environment(config.task, config.env)
