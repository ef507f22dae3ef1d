"""Two characters of different mass in one scene: Newton's third law, and who is who."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import quat, tasks
from dcc_jax.config import make_config
from dcc_jax.env.environment import Environment
from dcc_jax.tasks.chicken_fight import LONG
from dcc_jax.tasks.match import Match

MASSES = 85.0, 36.0  # kg, Sec. 5.3
STEPS = 10  # a third of a second
CLOSING = 1.5  # m/s, of each


def environment(mass: float, rate: int = 240) -> Environment:
    config = make_config("chicken-fight", "smoke")
    env = dataclasses.replace(config.env, mass=mass, physics_rate=rate)
    return tasks.make_environment(config.task, env)


@pytest.fixture(scope="module")
def match() -> Match:
    return Match(environment(MASSES[0]), environment(MASSES[1]), distance=0.7)


@pytest.fixture(scope="module")
def aloft(match):
    """Both fly 5 m above the floor and towards each other: the sides before, after."""

    def thrown(key):
        reset_key, step_key = jax.random.split(key)
        states = match.reset(reset_key, jnp.array([0.0, 0.16]))
        body = states[0].body
        qpos, qvel = body.qpos, jnp.zeros_like(body.qvel)
        for side, speed in zip(match.sides, (CLOSING, -CLOSING), strict=True):
            qpos = qpos.at[side.scene.qpos_adr + 2].add(5.0)
            qvel = qvel.at[side.scene.dof_adr].set(speed)
        body = dataclasses.replace(body, qpos=qpos, qvel=qvel)
        before = tuple(dataclasses.replace(s, body=body) for s in states)

        def step(sides, key):
            sides = match.step(key, sides, (jnp.zeros(36), jnp.zeros(36)))
            return sides, sides

        after = jax.lax.scan(step, before, jax.random.split(step_key, STEPS))[1]
        return states, before, after

    return jax.tree.map(np.array, jax.jit(thrown)(jax.random.key(0)))


def momenta(match: Match, body) -> np.ndarray:
    """Of both characters [2, 3] N s, by C MuJoCo."""
    model = match.scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = body.qpos, body.qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    roots = [model.body(name).id for name in ("pelvis", "rival_pelvis")]
    return model.body_subtreemass[roots, None] * data.subtree_linvel[roots]


def last(states):
    return jax.tree.map(lambda x: x[-1], states)


def test_each_character_has_its_mass_and_its_gains(match):
    model = match.scene.model
    for side, mass, name in zip(
        match.sides, MASSES, ("pelvis", "rival_pelvis"), strict=True
    ):
        body = model.body(name).id
        assert model.body_subtreemass[body] == pytest.approx(mass)
        assert side.scene.character.mass == mass
        dofs = slice(side.scene.dof_adr, side.scene.dof_adr + 42)
        damping = side.scene.timestep * side.scene.character.kv
        np.testing.assert_allclose(side.scene.spd_diagonal[dofs], damping)
        np.testing.assert_allclose(model.dof_armature[dofs], damping)
    assert match.sides[0].scene.model is match.sides[1].scene.model


def test_they_stand_face_to_face_and_see_each_other(match, aloft):
    states, _, _ = aloft
    for own, other in (states, states[::-1]):
        # The last four numbers: where the opponent is and how it moves.
        assert own.obs[-4] == pytest.approx(0.7, abs=0.05)
        assert abs(own.obs[-3]) < 0.1
        np.testing.assert_array_equal(own.body.qpos, other.body.qpos)
    velocities = [
        side.scene.character_qvel(state.body.qvel)[:2]
        for side, state in zip(match.sides, states, strict=True)
    ]
    # Each towards the other.
    np.testing.assert_allclose(velocities[0], [0.4, 0.0], atol=1e-3)
    np.testing.assert_allclose(velocities[1], [-0.4, 0.0], atol=1e-3)
    for state in states:
        # Seen from itself the target goes ahead, as it does.
        facing = quat.heading(state.reference.qpos[3:7])
        there = jnp.append(state.reference.qvel[:2], 0.0)
        ahead = quat.rotate(quat.inv(facing), there)
        np.testing.assert_allclose(ahead[:2], [0.4, 0.0], atol=0.05)
    x = [states[0].body.qpos[side.scene.qpos_adr] for side in match.sides]
    np.testing.assert_allclose(x, [-0.35, 0.35], atol=1e-6)


def test_no_two_matches_begin_alike(match):
    """Also where episodes begin at the start of a clip, as evaluations have it."""
    side = match.sides[0]
    moments = [
        float(side.task.first_reference(key, side.references, True).time)
        for key in jax.random.split(jax.random.key(4), 4)
    ]
    assert len(set(moments)) == 4


def test_impulses_are_opposite_and_are_what_each_gains(match, aloft):
    _, before, after = aloft
    given = [side.task.impulse.sum(axis=0) for side in after]
    assert given[0][0] < -20.0
    np.testing.assert_allclose(given[0], -given[1], atol=1e-3)
    start, end = (momenta(match, s.body) for s in (before[0], last(after[0])))
    flight = STEPS / 30.0
    for i, mass in enumerate(MASSES):
        fall = np.array([0.0, 0.0, -9.81 * mass * flight])
        np.testing.assert_allclose(end[i] - start[i] - fall, given[i], atol=0.5)


def test_momentum_is_conserved_in_flight(match, aloft):
    _, before, after = aloft
    start = momenta(match, before[0].body).sum(axis=0)
    np.testing.assert_allclose(
        start, [CLOSING * (MASSES[0] - MASSES[1]), 0.0, 0.0], atol=0.1
    )
    bodies = after[0].body
    for qpos, qvel in zip(bodies.qpos, bodies.qvel, strict=True):
        body = dataclasses.replace(before[0].body, qpos=qpos, qvel=qvel)
        now = momenta(match, body).sum(axis=0)
        np.testing.assert_allclose(now[:2], start[:2], atol=0.5)


def test_the_light_one_is_pushed_farther(match, aloft):
    _, before, after = aloft
    gained = []
    for side in match.sides:
        adr = side.scene.dof_adr
        gained.append(last(after[0]).body.qvel[adr] - before[0].body.qvel[adr])
    assert gained[0] < 0.0 < gained[1]
    assert gained[1] > 1.3 * abs(gained[0])


def test_both_share_one_body_and_note_the_same_bump(aloft):
    _, _, after = aloft
    np.testing.assert_array_equal(after[0].body.qpos, after[1].body.qpos)
    since = [side.task.since_bump for side in after]
    np.testing.assert_array_equal(since[0], since[1])
    assert since[0].max() > LONG and since[0][-1] < 0.4
    # Only the second was told to give way.
    stiff, compliant = (side.metrics.displacement.max() for side in after)
    assert stiff < 1e-5 and compliant > 1e-4


def test_sides_of_unequal_rate_are_refused(match):
    with pytest.raises(ValueError, match="physics_rate"):
        Match(match.sides[0], environment(36.0, rate=480))
