"""The door: its scene, the force at the knob, the grip, and where an episode begins."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import physics
from dcc_jax.character import Character, asset_path, compose_scene
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.observation import ALPHA_ENTRY, PHASE_SIZE
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks import door
from dcc_jax.tasks.door import Door

TASK = Door()
RESTING = 3  # of the states in which the hand pulls
HELD = (1.3, 2.0, 2.6, 3.2, 3.8)  # s, moments of the clip with the hand on the knob


@pytest.fixture(scope="module")
def clip() -> Clip:
    return load_clip(asset_path("motions/door.npz"))


@pytest.fixture(scope="module")
def environment(character: Character, clip: Clip) -> Environment:
    return Environment(TASK, character, make_references([clip]), EnvConfig())


def _start(environment: Environment, seconds: float) -> tuple:
    """Task state, qpos and qvel of an episode that begins at a moment of the clip."""
    reference = environment.references.state_at(0, seconds)
    return TASK.reset(jax.random.key(0), environment.scene, reference)


def _point(data: mujoco.MjData, site: str) -> np.ndarray:
    return data.site(site).xpos.copy()


# The scene.


def test_the_task_knows_the_clip_it_follows(clip):
    assert clip.duration > door.RELEASE_TIME


@pytest.mark.parametrize("width", [1.0, 1.7])
def test_knob_is_where_the_clip_has_it_and_swings_about_the_hinge(character, width):
    task = Door(width=width)
    model = compose_scene(character, extend=task.extend)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(_point(data, "knob"), door.KNOB, atol=1e-12)
    np.testing.assert_allclose(data.joint("hinge").xaxis, [0.0, 0.0, -1.0])
    anchor = np.array([*task.hinge, 0.0])
    np.testing.assert_allclose(data.joint("hinge").xanchor, anchor)
    data.joint("hinge").qpos[0] = 0.7
    mujoco.mj_kinematics(model, data)
    arm = _point(data, "knob") - anchor
    expected = [width * np.sin(0.7), width * np.cos(0.7), door.KNOB[2]]
    np.testing.assert_allclose(arm, expected, atol=1e-12)


def test_door_has_the_mass_and_inertia_of_a_plate(character):
    model = compose_scene(character, extend=TASK.extend)
    panel = model.body("door")
    span = TASK.width + door.EDGE
    mass = TASK.density * span * door.HEIGHT
    np.testing.assert_allclose(panel.mass, mass)
    assert 20.0 < mass < 35.0, "kg, of a solid inner door"
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    about_hinge = mass * (
        (span**2 + door.THICKNESS**2) / 12 + (span / 2) ** 2 + door.STANDOFF**2
    )
    dof = model.joint("hinge").dofadr[0]
    np.testing.assert_allclose(full[dof, dof], about_hinge, rtol=1e-6)
    np.testing.assert_allclose(model.dof_damping[dof], TASK.damping)


def test_the_characters_part_of_the_scene_comes_first(environment):
    scene = environment.scene
    assert (scene.qpos_adr, scene.dof_adr) == (0, 0)
    assert scene.model.joint("hinge").qposadr[0] == scene.character.nq


# The force at the knob.


@pytest.fixture(scope="module")
def pulled(environment):
    """States with the hand on the knob and torques on everything; what both say.

    The first three are at rest, the hand 1 cm from the knob; then two on the move; in
    the last the grip is open.
    """
    scene, model = environment.scene, environment.scene.model
    rng = np.random.default_rng(0)
    rows, qfrc = [], 20.0 * rng.normal(size=(len(HELD) + 1, model.nv))
    for i, seconds in enumerate((*HELD, HELD[1])):
        _, qpos, qvel = _start(environment, seconds)
        resting = i < RESTING
        qpos = qpos.at[model.joint("hinge").qposadr[0]].add(0.01 * resting)
        qpos = qpos.at[2].add(-0.003)  # into the floor: no contact in doubt
        rows.append((np.asarray(qpos), np.asarray(qvel) * (not resting)))
    active = np.array([True] * len(HELD) + [False])

    def solved(qpos, qvel, qfrc, active):
        body = physics.initial_state(scene, qpos, qvel)
        world = physics.default_world(scene).replace(equality_active=active[None])
        kin = physics.kinematics(scene, body, world)
        solution = physics.solve(scene, kin, body, qfrc)
        zero = jnp.zeros(())
        state = door.DoorState(jnp.asarray(2.0), active, zero, zero)
        return solution, TASK.forces(scene, state, kin, solution, jnp.zeros(36))

    qpos, qvel = (np.stack(part) for part in zip(*rows, strict=True))
    solution, (state, forces) = jax.jit(jax.vmap(solved))(
        *(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, qfrc)), jnp.asarray(active)
    )
    c = [_converged(model, *row) for row in zip(qpos, qvel, qfrc, active, strict=True)]
    return c, solution, state, forces, qfrc


def _converged(model, qpos, qvel, qfrc, active) -> mujoco.MjData:
    data = mujoco.MjData(model)
    model.opt.iterations, model.opt.tolerance = 100, 1e-12
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, qfrc
    data.eq_active[:] = active
    mujoco.mj_forward(model, data)
    return data


def test_force_at_the_knob_equals_c_mujocos(pulled):
    """At rest: C adds what is missing in MJX, the change of J with the motion."""
    c, solution, *_ = pulled
    ours = np.asarray(solution.equality_force)[:RESTING]
    for data, force in zip(c[:RESTING], ours, strict=True):
        theirs = data.efc_force[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        assert np.linalg.norm(theirs) > 20.0, "the grip must carry something"
        size = float(np.linalg.norm(theirs))
        np.testing.assert_allclose(force, theirs, atol=2e-3 * size)


def test_an_open_grip_carries_nothing(pulled):
    c, solution, _, forces, _ = pulled
    assert (np.asarray(solution.equality_force)[-1] == 0.0).all()
    assert (np.asarray(forces.force_w)[-1] == 0.0).all()
    np.testing.assert_allclose(
        np.asarray(solution.qacc)[-1], c[-1].qacc, atol=2e-3 * np.abs(c[-1].qacc).max()
    )


def test_torque_on_the_hinge_and_push_at_the_knob_accelerate_the_door(
    environment, pulled
):
    """I qdd = tau - c qd + width * push, with the known tau: sign, frame and size."""
    c, solution, state, _, qfrc = pulled
    model = environment.scene.model
    dof = model.joint("hinge").dofadr[0]
    for i, data in enumerate(c[:-1]):
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        tau = qfrc[i, dof] - TASK.damping * data.qvel[dof]
        push = np.asarray(state.parallel)[i] / (30.0 * environment.scene.timestep)
        expected = tau + TASK.width * push
        moved = full[dof, dof] * np.asarray(solution.qacc)[i, dof]
        np.testing.assert_allclose(moved, expected, atol=0.05)
        assert abs(push) > 1.0, "the hand must push"


def test_compliance_hears_the_share_orthogonal_to_the_knobs_path(pulled):
    c, solution, _, forces, _ = pulled
    heard = np.asarray(forces.force_w)[:, 0]
    for i, data in enumerate(c[:-1]):
        angle = data.joint("hinge").qpos[0]
        path = np.array([np.cos(angle), -np.sin(angle), 0.0])
        force = np.asarray(solution.equality_force)[i]
        assert abs(heard[i] @ path) < 1e-3
        np.testing.assert_allclose(heard[i] + (force @ path) * path, force, atol=1e-3)
        np.testing.assert_allclose(
            np.asarray(forces.point_w)[i, 0], data.site("palm").xpos, atol=1e-5
        )
    assert np.asarray(forces.gate).tolist() == [True] * len(HELD) + [False]


# Where an episode begins.


@pytest.mark.parametrize("seconds", HELD)
def test_an_episode_that_begins_in_the_grip_has_the_hand_on_the_knob(
    environment, seconds
):
    state, qpos, qvel = _start(environment, seconds)
    model = environment.scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    assert bool(state.holding)
    gap = _point(data, "palm") - _point(data, "knob")
    assert np.linalg.norm(gap) < 0.005
    jac = [np.zeros((3, model.nv)) for _ in range(2)]
    for site, J in zip(("palm", "knob"), jac, strict=True):
        mujoco.mj_jacSite(model, data, J, None, model.site(site).id)
    assert np.linalg.norm((jac[0] - jac[1]) @ data.qvel) < 0.1, "m/s, hand from knob"


@pytest.mark.parametrize(("seconds", "angle"), [(0.5, 0.0), (4.5, door.OPENING)])
def test_before_and_after_the_grip_the_door_rests(environment, seconds, angle):
    state, qpos, qvel = _start(environment, seconds)
    joint = environment.scene.model.joint("hinge")
    assert not bool(state.holding)
    np.testing.assert_allclose(qpos[joint.qposadr[0]], angle)
    assert float(qvel[joint.dofadr[0]]) == 0.0


def test_an_evaluation_begins_beside_the_start_of_the_clip(character, environment):
    config = EnvConfig(random_start=False)
    first = Environment(TASK, character, environment.references, config)
    keys = jax.random.split(jax.random.key(0), 8)
    states = jax.jit(jax.vmap(first.reset))(keys)
    np.testing.assert_allclose(states.task.time, 1 / 30, rtol=1e-5)
    np.testing.assert_allclose(states.reference.time, 1 / 30, rtol=1e-5)
    assert not np.asarray(states.task.holding).any()
    beside = np.asarray(states.body.qpos[:, :2] - states.reference.qpos[:, :2])
    assert 0.005 < np.abs(beside).max() <= TASK.start_radius + 1e-6
    features = environment.feature_size
    np.testing.assert_allclose(
        states.obs[:, :features], np.tile(states.obs[0, :features], (8, 1)), atol=1e-4
    )


# The task in the environment.


@pytest.fixture(scope="module")
def played(environment):
    """Eight control steps under the clip's own targets, from moments of the clip."""
    moments = jnp.array([0.2, 1.0, 2.0, 3.95])

    def play(seconds, key):
        start = environment.reset(key)
        reference = environment.references.state_at(0, seconds)
        task, qpos, qvel = TASK.reset(key, environment.scene, reference)
        state = start.replace(
            task=task,
            reference=reference,
            body=physics.initial_state(environment.scene, qpos, qvel),
            q_previous=reference.qpos_previous,
        )

        def step(state, key):
            state = environment.step(key, state, jnp.zeros(36))
            return state, state

        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 8))[1]

    keys = jax.random.split(jax.random.key(0), len(moments))
    return jax.jit(jax.vmap(play))(moments, keys)


def test_the_hand_takes_hold_near_the_knob_and_lets_go_on_time(played):
    holding = np.asarray(played.task.holding)
    assert not holding[0].any(), "too early in the clip"
    assert not holding[1, 0] and holding[1, -1], "takes hold at 1.2 s"
    assert holding[2].all(), "goes on holding"
    assert holding[3, 0] and not holding[3, -1], "lets go at 4.0 s"


def test_the_phase_goes_on_and_the_clip_is_followed(environment, played):
    seen = np.asarray(played.obs)[:, :, ALPHA_ENTRY + 1 :]
    phase, cos, sin = np.moveaxis(seen[:, :, :PHASE_SIZE], -1, 0)
    np.testing.assert_allclose(cos + 1j * sin, np.exp(2j * np.pi * phase), atol=1e-5)
    np.testing.assert_allclose(np.diff(phase), 1 / 150, rtol=1e-3)
    np.testing.assert_allclose(
        phase[:, 0], (np.array([0.2, 1.0, 2.0, 3.95]) + 1 / 30) / 5.0, rtol=1e-3
    )
    r_q = np.asarray(played.r_q)
    assert (r_q[:, 0] > 0.9).all() and (r_q <= 1.0).all()
    np.testing.assert_allclose(played.task.time, played.reference.time, atol=1e-5)


def test_physics_stays_calm_through_grasp_and_release(played):
    assert np.isfinite(np.asarray(played.obs)).all()
    assert not np.asarray(played.terminated).any()
    assert np.asarray(played.task.orthogonal).max() < 150.0
    assert np.asarray(played.metrics.force_peak).max() < 300.0


def test_reward_grows_with_the_angle_up_to_the_target(environment):
    _, qpos, qvel = _start(environment, 0.5)
    adr = environment.scene.model.joint("hinge").qposadr[0]
    for angle, expected in ((0.0, np.exp(-1.05)), (0.5, np.exp(-0.3)), (0.9, 1.0)):
        body = physics.initial_state(environment.scene, qpos.at[adr].set(angle), qvel)
        reward = TASK.reward(environment.scene, None, body)
        np.testing.assert_allclose(reward, expected, rtol=1e-6)


def test_a_door_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"task\.width must be positive, got -1\.0"):
        Door(width=-1.0)
    with pytest.raises(ValueError, match=r"task\.damping"):
        Door(damping=float("nan"))
