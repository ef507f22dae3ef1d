"""The partner's path, and the joint between the hands against C MuJoCo."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT, asset_path, compose_scene, load_character
from dcc_jax.motion import paths
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import References, RefState, make_references
from dcc_jax.tasks import hand_in_hand
from dcc_jax.tasks.hand_in_hand import HandInHand

TASK = HandInHand()
PARTNERS, STEPS = 50, 300
WEIGHT = np.array([20.0, -30.0, -98.1])  # N, a load that pulls sideways as well


@pytest.fixture(scope="module")
def scene() -> physics.Scene:
    character = load_character()
    model = compose_scene(character, extend=TASK.extend)
    return physics.make_scene(model, character)


@pytest.fixture(scope="module")
def reference() -> RefState:
    """In the middle of a run at 3 m/s, over the world's origin."""
    references = make_references([load_clip(asset_path("motions/run_cycle.npz"))])
    state = references.state_at(0, 0.25)
    shift = np.zeros(55, np.float32)
    shift[:2] = state.qpos[:2]
    return dataclasses.replace(
        state, qpos=state.qpos - shift, qpos_previous=state.qpos_previous - shift
    )


def _references() -> References:
    return make_references(
        [load_clip(asset_path(f"motions/{name}.npz")) for name in TASK.clips]
    )


class Aloft(NamedTuple):
    """The runner 5 m above the floor, its palm where the partner's hand is."""

    q: np.ndarray  # [55]
    palm: np.ndarray  # [3]
    hold: np.ndarray  # [42] generalized forces that carry its weight
    lift: np.ndarray  # [3, 42] Jacobian of the palm


@pytest.fixture(scope="module")
def aloft(scene, reference) -> Aloft:
    q = np.array(reference.qpos, float)
    q[2] += 5.0
    data = mujoco.MjData(scene.model)
    data.qpos[:] = q
    mujoco.mj_forward(scene.model, data)
    lift = np.zeros((3, 42))
    body = scene.body(hand_in_hand.HAND)
    palm = data.xmat[body].reshape(3, 3) @ hand_in_hand.PALM + data.xpos[body]
    mujoco.mj_jac(scene.model, data, lift, None, palm, body)
    return Aloft(q, palm, data.qfrc_bias.copy(), lift)


@pytest.fixture(scope="module")
def pull(scene, reference):
    """(state, partner's hand, qfrc) -> next state, accelerations, force fed."""
    task_state, _, _ = TASK.reset(jax.random.key(0), scene, reference)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(state: physics.State, hand: jax.Array, qfrc: jax.Array):
        world = physics.default_world(scene)
        world = dataclasses.replace(world, mocap_pos=hand[None])
        kin = physics.kinematics(scene, state, world)
        solution = physics.solve(scene, kin, state, qfrc)
        noted, forces = TASK.forces(scene, task_state, kin, solution, jnp.zeros(36))
        return physics.integrate(scene, state, solution), solution, noted, forces

    def call(q, qd, hand, qfrc, warm=None):
        arrays = [jnp.asarray(x, jnp.float32) for x in (q, qd, hand, qfrc)]
        state = physics.initial_state(scene, *arrays[:2]) if warm is None else warm
        return step(state, *arrays[2:])

    return call


@pytest.fixture(scope="module")
def walked():
    """Positions, headings, speeds at the control steps of PARTNERS partners."""
    velocity = jnp.array([3.0, 0.0])

    @jax.vmap
    def begin(key):
        return paths.begin(
            key, TASK.gaits, jnp.zeros(2), velocity, facing=jnp.zeros(())
        )

    @jax.vmap
    def go_on(key, motion):
        motion = paths.go_on(key, TASK.gaits, motion)
        return motion, paths.path(motion, motion.time + CONTROL_DT)

    @jax.jit
    def walk(first, keys):
        def step(motion, keys):
            motion, end = go_on(keys, motion)
            return motion, (motion, end)

        return jax.lax.scan(step, begin(first), keys)[1]

    first, rest = jax.random.split(jax.random.key(1))
    motions, (position, heading, speed) = walk(
        jax.random.split(first, PARTNERS), jax.random.split(rest, (STEPS, PARTNERS))
    )
    by_partner = (motions, position, heading, speed)
    return jax.tree.map(lambda x: np.moveaxis(np.array(x), 0, 1), by_partner)


def test_a_partner_goes_on_where_the_last_control_step_ended(walked):
    motions, position, heading, speed = walked
    np.testing.assert_allclose(motions.position[:, 1:], position[:, :-1], atol=1e-5)
    np.testing.assert_allclose(motions.heading[:, 1:], heading[:, :-1], atol=1e-5)
    np.testing.assert_allclose(motions.speed[:, 1:], speed[:, :-1], atol=1e-5)
    # The first control step begins at the reset, at the reference.
    np.testing.assert_allclose(motions.time[:, 0], 0.0, atol=1e-7)
    np.testing.assert_allclose(motions.position[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(motions.speed[:, 0], 3.0, atol=1e-6)


def test_a_partners_velocity_is_the_rate_of_its_position(walked):
    _, position, heading, speed = walked
    moved = np.linalg.norm(np.diff(position, axis=1), axis=-1)
    np.testing.assert_allclose(
        moved, 0.5 * CONTROL_DT * (speed[:, 1:] + speed[:, :-1]), atol=1e-4
    )
    going = moved > 0.01
    middle = 0.5 * (heading[:, 1:] + heading[:, :-1])
    course = np.arctan2(*np.moveaxis(np.diff(position, axis=1), -1, 0)[::-1])
    off = np.angle(np.exp(1j * (course - middle)))
    assert np.abs(off[going]).max() < 0.02


def test_partners_stand_walk_jog_run_and_turn_within_their_limits(walked):
    _, _, heading, speed = walked
    gaits = TASK.gaits
    assert speed.min() > -1e-5 and speed.max() < max(gaits.speeds) + 1e-4
    steady = np.abs(np.diff(speed, axis=1)) < 1e-6
    for wanted in gaits.speeds:
        at_it = np.abs(speed[:, 1:] - wanted) < 1e-3
        assert (at_it & steady).any(axis=1).mean() > 0.5, wanted
    assert np.abs(np.diff(speed, axis=1)).max() < 1.001 * gaits.acceleration / 30
    turn = np.diff(heading, axis=1) / CONTROL_DT
    assert turn.max() > 0.4 and turn.min() < -0.4
    assert np.abs(turn).max() < 1.001 * gaits.turn_rate
    # A turn that has begun may outlast the speed it was meant for a little.
    assert np.percentile(np.abs(turn * speed[:, 1:]), 99) < 1.05 * gaits.sideways
    assert np.abs(turn[speed[:, 1:] < 1e-3]).max() < 0.3


def test_different_keys_give_different_paths(walked):
    _, position, _, _ = walked
    ends = position[:, -1]
    gaps = np.linalg.norm(ends[:, None] - ends[None], axis=-1)
    assert np.median(gaps) > 5.0


def test_hands_are_joined_where_and_as_the_runners_palm_moves(scene, reference):
    state, _, _ = TASK.reset(jax.random.key(2), scene, reference)
    position, velocity = TASK.hand(state, jnp.zeros(()))
    palm = hand_in_hand.palm(reference.qpos)
    np.testing.assert_allclose(position, palm, atol=1e-5)
    before = hand_in_hand.palm(reference.qpos_previous)
    swing = (palm - before) / CONTROL_DT
    # The path is taken to be straight in the first control step; the hand rocks too.
    rocking = [0.0, 0.0, TASK.bounce * hand_in_hand.CADENCE]
    np.testing.assert_allclose(velocity, swing + np.array(rocking), atol=0.2)
    assert np.linalg.norm(swing) > 1.0


@pytest.mark.parametrize("seed", range(4))
def test_partner_of_a_planned_reference_begins_where_its_palm_is(scene, seed):
    key, reset_key = jax.random.split(jax.random.key(seed))
    begins = TASK.first_reference(key, _references(), False)
    assert np.linalg.norm(begins.sway) > 1e-3
    state, _, _ = TASK.reset(reset_key, scene, begins)
    position, _ = TASK.hand(state, jnp.zeros(()))
    np.testing.assert_allclose(position, hand_in_hand.palm(begins.qpos), atol=1e-5)
    # And the reference goes on from where it began, beside the same path.
    later = TASK.reference(_references(), state, begins, CONTROL_DT)
    moved = (later.qpos[:2] - begins.qpos[:2]) / CONTROL_DT
    np.testing.assert_allclose(moved, begins.qvel[:2], atol=0.2)


def test_palm_is_where_mujoco_has_it(aloft):
    palm = hand_in_hand.palm(jnp.asarray(aloft.q, jnp.float32))
    np.testing.assert_allclose(palm, aloft.palm, atol=1e-5)


def test_hand_velocity_is_the_rate_of_its_position(scene, reference):
    state, _, _ = TASK.reset(jax.random.key(3), scene, reference)
    motion = dataclasses.replace(
        state.motion, acceleration=jnp.array(-1.2), turn=jnp.array(0.5)
    )
    state = dataclasses.replace(state, motion=motion)
    for time in (0.01, 0.3):
        _, velocity = TASK.hand(state, jnp.array(time))
        ends = [TASK.hand(state, jnp.array(time + e))[0] for e in (-2e-3, 2e-3)]
        np.testing.assert_allclose(velocity, (ends[1] - ends[0]) / 4e-3, atol=0.02)


def test_the_reference_holds_its_hand_where_the_partner_has_it():
    references = _references()
    keys = jax.random.split(jax.random.key(8), 64)
    first = jax.vmap(lambda key: TASK.first_reference(key, references, False))(keys)
    gap = jax.vmap(hand_in_hand.palm)(first.qpos) - jnp.array(hand_in_hand.NOMINAL_HAND)
    np.testing.assert_allclose(np.mean(gap, axis=0), 0.0, atol=0.03)
    assert np.linalg.norm(gap, axis=-1).max() < 0.13
    stands = TASK.first_reference(jax.random.key(9), references, True)
    palm = hand_in_hand.palm(stands.qpos)
    np.testing.assert_allclose(palm, hand_in_hand.NOMINAL_HAND, atol=0.02)


@pytest.mark.parametrize("elapsed", [CONTROL_DT, 0.1])
def test_the_reference_runs_beside_the_partner(scene, elapsed):
    references = _references()
    begins = TASK.first_reference(jax.random.key(9), references, False)
    state, _, _ = TASK.reset(jax.random.key(4), scene, begins)
    turning = dataclasses.replace(state.motion, turn=jnp.array(0.5))
    state = dataclasses.replace(state, motion=turning)
    later = TASK.reference(references, state, begins, elapsed)
    position, heading, speed = paths.path(state.motion, begins.time + elapsed)
    assert np.linalg.norm(later.qpos[:2] - position) < 0.06, "it sways"
    way = speed * np.array([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(later.travel, way, atol=1e-6)
    assert np.linalg.norm(later.qvel[:2] - way) < 0.6
    ahead = quat.rotate(quat.heading(later.qpos[3:7]), jnp.array([1.0, 0.0, 0.0]))
    off = np.arctan2(ahead[1], ahead[0]) - heading
    assert abs(off) < 0.15, "but for the turns of the pelvis in a stride"
    np.testing.assert_allclose(later.time - begins.time, elapsed, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_constraint_force_equals_c_mujocos(scene, aloft, pull, seed):
    rng = np.random.default_rng(seed)
    # C MuJoCo also has the rate of the Jacobian in a joint's rows, MJX has not: the
    # bodies may move, but not turn.
    qd, qfrc = np.zeros(42), rng.normal(0.0, 30.0, 42)
    qd[:3] = rng.normal(0.0, 1.0, 3)
    hand = aloft.palm + rng.normal(0.0, 0.01, 3)
    _, _, noted, forces = pull(aloft.q, qd, hand, qfrc)
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = aloft.q, qd, qfrc
    data.mocap_pos[0] = hand
    mujoco.mj_forward(scene.model, data)
    assert data.ne == 3 and data.ncon == 0
    expected = data.efc_force[:3]
    np.testing.assert_allclose(forces.force_w[0], expected, rtol=2e-3, atol=0.2)
    np.testing.assert_allclose(forces.point_w[0], aloft.palm, atol=1e-5)
    # It is a world-frame force on the palm: J^T f is what the joints feel.
    np.testing.assert_allclose(
        aloft.lift.T @ np.array(forces.force_w[0]), data.qfrc_constraint, atol=1.0
    )
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(noted.force_peak, size, rtol=2e-3)
    np.testing.assert_allclose(noted.force_square, size**2 * scene.timestep, rtol=4e-3)


def test_partner_bears_a_weight_that_hangs_on_the_hand(scene, aloft, pull):
    qfrc = aloft.hold + aloft.lift.T @ WEIGHT
    state = forces = None
    for _ in range(60):
        state, _, _, forces = pull(aloft.q, np.zeros(42), aloft.palm, qfrc, state)
    assert forces is not None
    np.testing.assert_allclose(forces.force_w[0], -WEIGHT, atol=1.0)


def test_hand_and_gravity_alone_move_a_body_aloft(scene, aloft, pull):
    # Newton's second law for the whole body, whatever its joints do: m a = m g + f.
    joints = aloft.hold * (np.arange(42) >= 6)
    _, solution, _, forces = pull(aloft.q, np.zeros(42), aloft.palm, joints)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = aloft.q
    mujoco.mj_forward(scene.model, data)
    mass = np.zeros((42, 42))
    mujoco.mj_fullM(scene.model, data, mass)
    momentum_rate = (mass @ np.array(solution.qacc))[:3]
    weight = np.array([0.0, 0.0, 65.0 * 9.81])
    np.testing.assert_allclose(
        momentum_rate + data.qfrc_bias[:3], forces.force_w[0], atol=0.5
    )
    np.testing.assert_allclose(data.qfrc_bias[:3], weight, atol=0.1)
    assert np.linalg.norm(forces.force_w[0]) > 10.0


def test_no_force_where_both_run_at_the_same_speed(aloft, pull):
    qd = np.zeros(42)
    qd[:3] = (3.0, 0.5, 0.0)
    ahead = aloft.palm + hand_in_hand.LEAD * qd[:3]
    *_, forces = pull(aloft.q, qd, ahead, aloft.hold)
    *_, dragged = pull(aloft.q, qd, aloft.palm, aloft.hold)
    assert np.linalg.norm(forces.force_w[0]) < 1.0
    assert np.linalg.norm(dragged.force_w[0]) > 100.0


def test_the_world_holds_the_partners_hand_ahead_and_turns_it_along_the_path(
    scene, reference
):
    state, _, _ = TASK.reset(jax.random.key(5), scene, reference)
    time = jnp.array(0.02)
    world = TASK.world(scene, state, time)
    position, velocity = TASK.hand(state, time)
    ahead = position + hand_in_hand.LEAD * velocity
    np.testing.assert_allclose(world.mocap_pos[0], ahead, atol=1e-6)
    turned = 2.0 * np.arctan2(world.mocap_quat[0, 3], world.mocap_quat[0, 0])
    np.testing.assert_allclose(turned, state.motion.heading, atol=1e-6)
    assert bool(world.equality_active.all())


def test_parted_hands_and_a_dragged_character_end_the_episode(scene, reference):
    state, qpos, qvel = TASK.reset(jax.random.key(6), scene, reference)
    state, _ = TASK.control_step(jax.random.key(7), scene, state, None)
    run = float(CONTROL_DT * state.motion.speed)
    here = np.array([run, 0.0]) @ _rotation(float(state.motion.heading)).T

    def ended(shift):
        q = qpos.at[:2].add(jnp.asarray(shift, jnp.float32))
        body = physics.initial_state(scene, q, qvel)
        numbers = TASK.evaluate(scene, state, body)
        return bool(TASK.terminated(scene, state, body)), numbers

    over, numbers = ended(here)
    assert not over
    np.testing.assert_allclose(numbers["path_distance"], 0.0, atol=1e-4)
    np.testing.assert_allclose(numbers["partner_speed"], state.motion.speed, atol=1e-4)
    assert float(numbers["hand_gap"]) < 0.1
    over, numbers = ended(here + np.array([0.0, 0.4]))
    assert over and abs(float(numbers["path_distance"]) - 0.4) < 1e-3
    assert float(numbers["hand_gap"]) > TASK.longest_gap


def _rotation(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])
