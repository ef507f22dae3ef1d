"""The schedule of the pushes, and what they do by Newton's second law."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import dcc_jax
from dcc_jax import physics, tasks
from dcc_jax.character import CONTROL_DT, asset_path, load_character
from dcc_jax.motion import paths
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import make_references, planar_moved
from dcc_jax.tasks.sustained_push import SustainedPush, SustainedPushState

TASK = SustainedPush()
STEPS, PUSHED = 900, 30


@pytest.fixture(scope="module")
def references():
    clips = [load_clip(asset_path(f"motions/{name}.npz")) for name in TASK.clips]
    return make_references(clips)


@pytest.fixture(scope="module")
def schedules(scene, references):
    """States of PUSHED characters after each of STEPS control steps, [T, B]."""
    stand_key, body_key, reset_key, run_key = jax.random.split(jax.random.key(0), 4)
    standing = TASK.first_reference(stand_key, references, True)
    begin = jax.vmap(lambda key: TASK.reset(key, scene, standing)[0])
    body = physics.initial_state(scene, *TASK.reset(body_key, scene, standing)[1:])
    go_on = jax.vmap(lambda key, state: TASK.control_step(key, scene, state, body)[0])

    @jax.jit
    def run(first, keys):
        def step(state, keys):
            state = go_on(keys, state)
            return state, state

        return jax.lax.scan(step, begin(first), keys)[1]

    first = jax.random.split(reset_key, PUSHED)
    keys = jax.random.split(run_key, (STEPS, PUSHED))
    return jax.tree.map(np.array, run(first, keys))


def spans(pushing: np.ndarray) -> tuple[list[int], list[int]]:
    """Lengths in control steps of whole pushes and whole pauses of one character."""
    edges = np.flatnonzero(np.diff(pushing))
    lengths = np.diff(edges).tolist()
    first_is_push = not pushing[0]
    return lengths[not first_is_push :: 2], lengths[first_is_push::2]


def test_pushes_and_pauses_take_turns(schedules):
    pushing = np.any(schedules.force_w != 0.0, axis=-1)
    pushes, pauses = zip(*(spans(row) for row in pushing.T), strict=True)
    for lengths, (shortest, longest) in (
        (np.concatenate(pushes), TASK.duration),
        (np.concatenate(pauses), TASK.pause),
    ):
        assert len(lengths) > 100
        seconds = lengths * CONTROL_DT
        assert seconds.min() > shortest - 0.01
        assert seconds.max() < longest + 2.01 * CONTROL_DT


def test_a_push_does_not_change_while_it_lasts(schedules):
    force = schedules.force_w
    same = (force[1:] == force[:-1]).all(axis=-1)
    begun = schedules.since[1:] <= schedules.since[:-1]
    ended = (force[1:] == 0.0).all(axis=-1)
    assert (same | begun | ended).all()
    np.testing.assert_array_equal(
        schedules.target[1:][~begun], schedules.target[:-1][~begun]
    )


def test_pushes_have_all_directions_strengths_and_bodies(schedules):
    begun = schedules.since[1:] <= schedules.since[:-1]
    force, target = schedules.force_w[1:][begun], schedules.target[1:][begun]
    size = np.linalg.norm(force, axis=-1)
    weak, strong = TASK.strength
    assert weak <= size.min() < weak + 5 and strong - 5 < size.max() <= strong + 1e-3
    slope = np.arcsin(force[:, 2] / size)
    assert 0.9 * TASK.slope < np.abs(slope).max() <= TASK.slope + 1e-5
    way = np.arctan2(force[:, 1], force[:, 0])
    assert np.histogram(way, bins=4, range=(-np.pi, np.pi))[0].min() > len(way) / 8
    assert np.bincount(target).min() > len(target) / 10


def test_a_push_accelerates_the_character_by_force_over_mass(
    scene, character, compiled_solve
):
    # Aloft, with nothing else but gravity: M qacc + bias = J^T f.
    count = len(TASK.bodies)
    q = np.array(scene.model.qpos0, np.float32)
    q[2] += 5.0
    state = jax.vmap(lambda _: physics.initial_state(scene, q, jnp.zeros(42)))(
        jnp.arange(count)
    )
    force = jnp.array([30.0, -50.0, 10.0])

    @jax.jit
    @jax.vmap
    def pushed(state, target):
        kin = physics.kinematics(scene, state)
        push = SustainedPushState(None, force, target, jnp.ones(()), jnp.ones(()))
        return TASK.applied(scene, push, kin, jnp.zeros(())), TASK._place(
            scene, push, kin
        )

    qfrc, (body, point) = pushed(state, jnp.arange(count))
    solution, *_ = compiled_solve(state, qfrc, jnp.zeros((count, 42)))
    data = mujoco.MjData(scene.model)
    data.qpos[:] = q
    for i, name in enumerate(TASK.bodies):
        assert scene.model.body(int(body[i])).name == name
        data.xfrc_applied[:] = 0.0
        data.xfrc_applied[int(body[i]), :3] = force
        mujoco.mj_forward(scene.model, data)
        np.testing.assert_allclose(point[i], data.xipos[int(body[i])], atol=1e-5)
        np.testing.assert_allclose(
            solution.qacc[i], data.qacc, rtol=2e-3, atol=2e-3 * np.abs(data.qacc).max()
        )
    assert character.mass == load_character().mass


def test_path_stops_and_runs_and_the_reference_keeps_to_it(scene, references):
    first = TASK.first_reference(jax.random.key(1), references, False)
    state, qpos, qvel = TASK.reset(jax.random.key(2), scene, first)
    body = physics.initial_state(scene, qpos, qvel)

    @jax.jit
    def step(key, state, reference):
        there = dataclasses.replace(body, qpos=qpos.at[:55].set(reference.qpos))
        state, _ = TASK.control_step(key, scene, state, there)
        return state, TASK.reference(references, state, reference, CONTROL_DT)

    speeds, reference = [], first
    for key in jax.random.split(jax.random.key(3), STEPS):
        state, reference = step(key, state, reference)
        root, heading, speed = paths.path(state.motion, state.motion.time + CONTROL_DT)
        assert np.linalg.norm(reference.qpos[:2] - root) < 0.06, "it sways"
        velocity = speed * paths.direction(heading)
        np.testing.assert_allclose(reference.travel, velocity, atol=1e-4)
        speeds.append(float(speed))
    assert min(speeds) < 0.01 and max(speeds) > 2.9


def test_path_is_seen_in_the_characters_frame(scene, references):
    first = TASK.first_reference(jax.random.key(0), references, True)
    state, qpos, qvel = TASK.reset(jax.random.key(0), scene, first)
    motion = dataclasses.replace(
        state.motion,
        time=jnp.zeros(()),
        position=first.qpos[:2] + jnp.array([0.3, 0.1]),
        heading=jnp.zeros(()),
        speed=jnp.array(1.5),
        acceleration=jnp.zeros(()),
        turn=jnp.zeros(()),
    )
    state = dataclasses.replace(state, motion=motion)
    body = physics.initial_state(scene, qpos, qvel)
    along = 1.5 * CONTROL_DT
    expected = [0.3 + along, 0.1, 1.5, 0.0, 1.0, 0.0]
    turn = 2.0 * np.pi / 3.0
    for angle in (0.0, turn):
        # The character turns, what it sees turns the other way.
        q = planar_moved(first.qpos, jnp.array(angle), jnp.zeros(2))
        q = q.at[:2].set(first.qpos[:2])
        turned = dataclasses.replace(body, qpos=body.qpos.at[:55].set(q))
        seen = TASK.observe(scene, state, turned).reshape(3, 2)
        back = seen @ np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        facing = _facing(first.qpos)
        spun = np.array(expected).reshape(3, 2) @ np.array(
            [[np.cos(facing), -np.sin(facing)], [np.sin(facing), np.cos(facing)]]
        )
        np.testing.assert_allclose(back, spun, atol=1e-4)


@pytest.mark.parametrize(("away", "left"), [(0.7, 0.7), (1.3, 0.8)])
def test_path_waits_for_who_is_left_behind(scene, references, away, left):
    first = TASK.first_reference(jax.random.key(0), references, True)
    state, qpos, qvel = TASK.reset(jax.random.key(0), scene, first)
    beside = state.motion.position + jnp.array([0.0, away])
    body = physics.initial_state(scene, qpos.at[:2].set(beside), qvel)
    later, _ = TASK.control_step(jax.random.key(0), scene, state, body)
    numbers = TASK.evaluate(scene, later, body)
    assert numbers["path_distance"] == pytest.approx(left, abs=1e-3)
    # On the line between the two.
    assert later.motion.position[0] == pytest.approx(float(beside[0]), abs=1e-5)


def _facing(qpos) -> float:
    w, x, y, z = np.asarray(qpos[3:7])
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


@pytest.mark.parametrize("imitation", ["tracking", "adversarial"])
def test_who_tracks_the_reference_sways_with_it_and_others_need_not(imitation):
    made = dcc_jax.make_config("sustained-push", preset="smoke")
    env = dataclasses.replace(made.env, imitation=imitation)
    environment = tasks.make_environment(made.task, env)
    state = environment.reset(jax.random.key(3))
    at = state.reference
    assert np.linalg.norm(at.sway) > 1e-3
    target = environment._root_target(state)
    if imitation == "tracking":
        np.testing.assert_array_equal(target.position, at.qpos[:2])
        np.testing.assert_array_equal(target.velocity, at.qvel[:2])
    else:
        np.testing.assert_allclose(target.position, at.qpos[:2] - at.sway, atol=1e-6)
        np.testing.assert_allclose(target.velocity, at.travel, atol=1e-5)
