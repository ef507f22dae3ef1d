"""Physics against C MuJoCo, and the stable PD against its explicit equation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import physics
from dcc_jax.character import Character, compose_scene
from dcc_jax.control import pd

BATCH = 8
_SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


def _random_poses(scene: physics.Scene, seed: int, spread: float) -> np.ndarray:
    """[BATCH, nq] random joints around the T-pose, the lowest sole at z = 0."""
    rng = np.random.default_rng(seed)
    model, data = scene.model, mujoco.MjData(scene.model)
    qpos = np.tile(model.qpos0, (BATCH, 1))
    for row in qpos:
        mujoco.mj_integratePos(
            model, row, np.r_[0, 0, 0, spread * rng.normal(size=model.nv - 3)], 1.0
        )
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        soles = [g for g in range(model.ngeom) if "_sole_" in model.geom(g).name]
        row[2] -= data.geom_xpos[soles, 2].min() - 0.02
    return qpos


def _converged(
    scene: physics.Scene, qpos: np.ndarray, qvel: np.ndarray, qfrc: np.ndarray
) -> mujoco.MjData:
    """C MuJoCo's forward dynamics of the same model, iterated to convergence."""
    model = scene.model
    data = mujoco.MjData(model)
    model.opt.iterations, model.opt.tolerance = 100, 1e-12
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, qfrc
    mujoco.mj_forward(model, data)
    return data


def _contact_force_w(
    model: mujoco.MjModel, data: mujoco.MjData, foot: int
) -> np.ndarray:
    """World force [3] of all contacts on a body."""
    total, force = np.zeros(3), np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        bodies = model.geom_bodyid[[contact.geom1, contact.geom2]]
        mujoco.mj_contactForce(model, data, i, force)
        sign = float(bodies[1] == foot) - float(bodies[0] == foot)
        total += sign * contact.frame.reshape(3, 3).T @ force[:3]
    return total


@pytest.fixture(scope="module")
def landing(scene, compiled_solve):
    """States with the soles 1 to 6 mm deep, sinking and sliding, and what both say."""
    rng = np.random.default_rng(0)
    qpos = _random_poses(scene, 1, 0.05)
    qpos[:, 2] -= rng.uniform(0.001, 0.006, BATCH)
    qvel = 0.3 * rng.normal(size=(BATCH, scene.model.nv))
    qvel[:, 2] -= 1.0
    qfrc = 20.0 * rng.normal(size=(BATCH, scene.model.nv))
    wrench = rng.normal(size=(BATCH, scene.model.nv))
    c = [_converged(scene, *row) for row in zip(qpos, qvel, qfrc, strict=True)]
    states = physics.State(
        *(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros_like(qvel)))
    )
    out = compiled_solve(
        states, jnp.asarray(qfrc, jnp.float32), jnp.asarray(wrench, jnp.float32)
    )
    return c, out, wrench


def test_accelerations_equal_converged_c_mujoco_in_landings(landing):
    c, (solution, *_), _ = landing
    for data, qacc in zip(c, np.asarray(solution.qacc), strict=True):
        np.testing.assert_allclose(qacc, data.qacc, atol=2e-3 * np.abs(data.qacc).max())


def test_contact_forces_equal_c_mujoco_per_foot(scene, landing):
    c, (solution, *_), _ = landing
    for name in ("left_foot", "right_foot"):
        foot = scene.body(name)
        slots = scene.contact_bodies[:, 1] == foot
        ours = np.asarray(solution.contact_force_w)[:, slots].sum(axis=1)
        theirs = np.array([_contact_force_w(scene.model, data, foot) for data in c])
        assert np.abs(theirs).max() > 100.0, "the feet must be loaded"
        error = np.linalg.norm(ours - theirs, axis=1)
        assert (error < 1e-3 * (np.linalg.norm(theirs, axis=1) + 100.0)).all()


def test_mass_solve_is_c_mujocos_without_the_implicit_damping(scene, landing):
    c, (_, solved, *_), wrench = landing
    for data, x, b in zip(c, np.asarray(solved), wrench, strict=True):
        mass = np.zeros((scene.model.nv, scene.model.nv))
        mujoco.mj_fullM(scene.model, data, mass)
        mass -= np.diag(scene.spd_diagonal)
        np.testing.assert_allclose(mass @ x, b, atol=2e-3)


def test_point_jacobians_and_positions_equal_c_mujoco(scene, landing):
    c, (*_, J, body_pos), _ = landing
    for data, jac, pos in zip(c, np.asarray(J), np.asarray(body_pos), strict=True):
        np.testing.assert_allclose(pos, data.xpos, atol=2e-6)
        for name, ours in zip(("left_foot", "right_hand"), jac, strict=True):
            theirs = np.zeros((3, scene.model.nv))
            mujoco.mj_jacBody(scene.model, data, theirs, None, scene.body(name))
            np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize("names", [("left_hand", "head"), ("left_hand",)])
def test_generalized_force_equals_c_mujoco(scene, landing, names):
    c, _, _ = landing
    rng = np.random.default_rng(4)
    bodies = np.array([scene.body(name) for name in names])
    force_w = 50.0 * rng.normal(size=(BATCH, len(names), 3))
    point_w = np.stack([data.xpos[bodies] for data in c])
    point_w += 0.1 * rng.normal(size=point_w.shape)

    @jax.jit
    @jax.vmap
    def ours(qpos, qvel, point_w, force_w):
        state = physics.State(qpos, qvel, jnp.zeros_like(qvel))
        kin = physics.kinematics(scene, state)
        where = point_w, jnp.asarray(bodies)
        return physics.generalized_force(scene, kin, *where, force_w)

    states = (np.stack([getattr(d, name) for d in c]) for name in ("qpos", "qvel"))
    given = (jnp.asarray(x, jnp.float32) for x in (*states, point_w, force_w))
    for i, found in enumerate(np.asarray(ours(*given))):
        theirs = np.zeros(scene.model.nv)
        for body, point, force in zip(bodies, point_w[i], force_w[i], strict=True):
            mujoco.mj_applyFT(
                scene.model, c[i], force, np.zeros(3), point, body, theirs
            )
        np.testing.assert_allclose(found, theirs, atol=1e-5 * np.abs(theirs).max())


def _with_pad(*joints: dict[str, Any]) -> Callable[[mujoco.MjSpec], None]:
    """Adds a body beside the character that moves by these joints."""

    def extend(spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name="pad", pos=[2, 0, 1])
        body.add_geom(size=[0.1, 0.1, 0.1], mass=3.0, contype=0, conaffinity=0)
        for joint in joints:
            body.add_joint(**joint)

    return extend


@pytest.mark.parametrize("turning", [False, True], ids=["slide and hinge", "ball"])
def test_springs_and_dampers_equal_c_mujoco(character: Character, turning: bool):
    given = {"stiffness": [300.0, 0, 0], "damping": [7.0, 0, 0]}
    slide = {"type": _SLIDE, "axis": [0, 0, 1], "springref": 0.3}
    hinge = {"type": mujoco.mjtJoint.mjJNT_HINGE, "axis": [0, 1, 0]}
    ball = {"type": mujoco.mjtJoint.mjJNT_BALL}
    joints = [joint | given for joint in ([ball] if turning else [slide, hinge])]
    model = compose_scene(character, floor=False, extend=_with_pad(*joints))
    scene = physics.make_scene(model, character)
    rng, data = np.random.default_rng(5), mujoco.MjData(scene.model)
    turned = 0.4 * rng.normal(size=model.nv)
    mujoco.mj_integratePos(scene.model, data.qpos, turned, 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(scene.model, data)
    assert np.abs(data.qfrc_passive[42:]).min() > 1.0
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in (data.qpos, data.qvel))

    @jax.jit
    def ours(state: physics.State) -> jax.Array:
        kin = physics.kinematics(scene, state)
        return physics.solve(scene, kin, state, jnp.zeros(model.nv)).qacc

    pad = ours(physics.initial_state(scene, qpos, qvel))[42:]
    np.testing.assert_allclose(pad, data.qacc[42:], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("flag", ["SPRING", "DAMPER"])
def test_springs_and_dampers_can_be_switched_off(character: Character, flag: str):
    slide = {"type": _SLIDE, "stiffness": [300.0, 0, 0], "damping": [7.0, 0, 0]}
    model = compose_scene(character, floor=False, extend=_with_pad(slide))
    model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")
    scene = physics.make_scene(model, character)
    data = mujoco.MjData(scene.model)
    data.qpos[-1], data.qvel[-1] = 0.2, 0.5
    mujoco.mj_forward(scene.model, data)
    state = physics.initial_state(
        scene, jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32)
    )
    kin = physics.kinematics(scene, state)
    found = jax.jit(lambda: physics.solve(scene, kin, state, jnp.zeros(model.nv)))()
    np.testing.assert_allclose(found.qacc[-1], data.qacc[-1], rtol=1e-4)


@pytest.mark.parametrize(
    ("given", "limits"),
    [({"frictionloss": 5.0}, True), ({"frictionloss": 5.0}, False), ({}, False)],
)
def test_constraints_that_the_solver_does_not_know_are_refused(
    character, given, limits
):
    slide = {"type": _SLIDE, "range": [-1, 1]} | given
    model = compose_scene(character, floor=False, extend=_with_pad(slide))
    if not limits:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    with pytest.raises(ValueError, match="the contact solver knows contacts"):
        physics.make_scene(model, character)


def test_stable_pd_is_the_explicit_equation(character: Character):
    """(M + h Kv) qdd = Kp (q_bar - q - h qd) - Kv qd - bias, in double precision."""
    plain = compose_scene(character, floor=False)
    scene = physics.make_scene(plain, character)
    h, data = plain.opt.timestep, mujoco.MjData(plain)
    rng = np.random.default_rng(3)
    qpos, q_bar = plain.qpos0.copy(), plain.qpos0.copy()
    # Errors of about 1 rad: at 0.3 rad a wrong frame or sign hides.
    error = np.r_[np.zeros(6), 0.6 * rng.normal(size=36)]
    mujoco.mj_integratePos(plain, qpos, np.r_[np.zeros(6), rng.normal(size=36)], 1.0)
    q_bar[:] = qpos
    mujoco.mj_integratePos(plain, q_bar, error, 1.0)
    q_bar[7::4] *= -1.0
    q_bar[8::4] *= -1.0
    q_bar[9::4] *= -1.0
    q_bar[10::4] *= -1.0
    qd = rng.normal(size=42)
    data.qpos[:], data.qvel[:] = qpos, qd
    mujoco.mj_forward(plain, data)
    mass = np.zeros((42, 42))
    mujoco.mj_fullM(plain, data, mass)
    kp, kv = character.kp, character.kv
    angle = np.linalg.norm(error[6:].reshape(12, 3), axis=1)
    assert angle.max() < np.pi, "the short way round must be the error itself"
    explicit = np.linalg.solve(
        mass + h * np.diag(kv), kp * (error - h * qd) - kv * qd - data.qfrc_bias
    )

    tau = pd.unclipped(
        character, jnp.asarray(qpos), jnp.asarray(qd), jnp.asarray(q_bar), h
    )
    ours = mujoco.MjData(scene.model)
    ours.qpos[:], ours.qvel[:], ours.qfrc_applied[:] = qpos, qd, np.asarray(tau)
    mujoco.mj_forward(scene.model, ours)
    np.testing.assert_allclose(ours.qacc, explicit, atol=2e-3)


def test_torque_stays_within_the_limits_and_spares_the_root(character: Character):
    q = jnp.asarray(compose_scene(character, floor=False).qpos0, jnp.float32)
    tau = pd.clipped(character, jnp.full(42, 1e6))
    assert (np.asarray(tau)[6:] == character.torque_limit[6:].astype(np.float32)).all()
    at_rest = pd.torque(character, q, jnp.ones(42), q, 1 / 240)
    assert (np.asarray(at_rest)[:6] == 0.0).all()


def test_unknown_names_and_settings_are_refused(character: Character, scene):
    with pytest.raises(ValueError, match="unknown body 'tail'"):
        scene.body("tail")
    with pytest.raises(ValueError, match="unknown joint 'hook'"):
        physics.make_scene(scene.model, character, root="hook")
    with pytest.raises(ValueError, match="newton_iterations"):
        physics.make_scene(scene.model, character, newton_iterations=0)
    with pytest.raises(ValueError, match="unknown joint 'hook'"):
        scene.address("hook")


def test_contacts_of_the_ground_are_those_of_both_feet_with_the_sign_turned(scene):
    feet = [scene.body(name) for name in ("left_foot", "right_foot")]
    own, ground = scene.contacts(feet), scene.contacts([0], feet)
    assert len(own.slots) == 8 and len(scene.contacts(feet[:1]).slots) == 4
    np.testing.assert_array_equal(own.slots, ground.slots)
    np.testing.assert_array_equal(own.body, ground.other)
    np.testing.assert_array_equal(own.sign, -ground.sign)
    assert not scene.contacts(feet[:1], feet[1:]).slots.size


def test_address_of_a_joint_is_mujocos(scene):
    knee = scene.model.joint("left_knee")
    assert scene.address("left_knee") == (knee.qposadr[0], knee.dofadr[0])
