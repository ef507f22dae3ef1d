"""compliance.py: Alg. 1 by hand, its bounds, its return; Eq. (4) and (7) simulated."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from dcc_jax import quat
from dcc_jax.character import asset_path, load_character
from dcc_jax.control import compliance
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.control.stiffness import (
    determinant,
    modulated_stiffness,
    softened_gains,
    stiffness,
)
from dcc_jax.motion.clip import load_clip

CHARACTER = load_character()
MODEL = CHARACTER.spec().compile()
COORDS = quat.Coordinates.of(MODEL)
CONFIG = ComplianceConfig()
REST = compliance.at_rest(COORDS)
H = CONFIG.response_time
BATCH = 96
STEPS = 480
DT = 1.0 / 240.0


def controller(weights=CHARACTER.column_weight, dt=DT):
    """Of the character, at the default settings."""
    return compliance.Controller(CONFIG, COORDS, weights, dt, np.ones(MODEL.nv))


@jax.jit
@jax.vmap
@chex.assert_max_traces(1)
def velocity(J, inverse, force, alpha, weights):
    """ud [BATCH, 42] of one force in each of BATCH environments, and delta_qdd."""
    delta_qdd = []

    def mass_solve(qfrc):
        delta_qdd.append(qfrc @ inverse)
        return delta_qdd[0]

    displacement = compliance.algorithm_1(
        controller(weights), REST, J[None], force[None], alpha, None, mass_solve
    )
    return displacement.ud, delta_qdd[0][0]


@jax.jit
@jax.vmap
@chex.assert_max_traces(1)
def measured_velocity(J, xd, alpha, weights):
    """ud [BATCH, 42] from measured velocities [BATCH, 3] of the points."""
    return compliance.measured(
        controller(weights), REST, J[None], jnp.ones((1, 3)), alpha, None, xd[None]
    ).ud


@jax.jit
@chex.assert_max_traces(1)
def course(displacement, ud_forces, active_steps, dt):
    """STEPS steps under the same ud, of which the first few are active.

    Returns the last displacement and log u after every step, [STEPS, 42].
    """

    def step(displacement, index):
        displacement = compliance.advance(
            controller(dt=dt), displacement, ud_forces, index < active_steps
        )
        return displacement, quat.log_map(COORDS, displacement.u)

    return jax.lax.scan(step, displacement, jnp.arange(STEPS))


@dataclass(frozen=True)
class Pushes:
    """One push in each of BATCH environments, zeros after the last."""

    J: np.ndarray  # [BATCH, 3, 42]
    inverse: np.ndarray  # [BATCH, 42, 42] M^-1
    force: np.ndarray  # [BATCH, 3] N

    @classmethod
    def of(cls, rows: list[tuple[np.ndarray, int, np.ndarray]]) -> Pushes:
        """Of poses, bodies at whose origins the forces act, and forces."""
        arrays = [(*mechanics(q, [body], False), force) for q, body, force in rows]
        J, inverse, force = (
            np.pad(
                np.array(x, np.float32),
                [(0, BATCH - len(rows))] + [(0, 0)] * (np.ndim(x) - 1),
            )
            for x in zip(*((J[0], Mi, f) for J, Mi, f in arrays), strict=True)
        )
        return cls(J, inverse, force)


def mechanics(q: np.ndarray, bodies, centres: bool) -> tuple[np.ndarray, np.ndarray]:
    """J [len(bodies), 3, 42] of origins or centres of mass, and M^-1, by C MuJoCo."""
    data = mujoco.MjData(MODEL)
    data.qpos[:] = q
    mujoco.mj_forward(MODEL, data)
    J, inverse = np.zeros((len(bodies), 3, MODEL.nv)), np.zeros((MODEL.nv, MODEL.nv))
    for of, body in zip(J, bodies, strict=True):
        point = data.xipos[body] if centres else data.xpos[body]
        mujoco.mj_jac(MODEL, data, of, None, point, body)
    mujoco.mj_solveM(MODEL, data, inverse, np.eye(MODEL.nv))
    return J, inverse


def random_pushes(seed: int, newtons: float) -> Pushes:
    """Random poses, bodies and directions."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(BATCH):
        q = MODEL.qpos0.copy()
        mujoco.mj_integratePos(MODEL, q, rng.normal(0.0, 0.5, MODEL.nv), 1.0)
        force = rng.normal(size=3)
        force *= newtons / np.linalg.norm(force)
        rows.append((q, int(rng.integers(1, MODEL.nbody)), force))
    return Pushes.of(rows)


def spread(alpha, weights):
    """alpha and weights for every environment."""
    weights = np.broadcast_to(weights, (BATCH, MODEL.nv))
    return jnp.full(BATCH, alpha, jnp.float32), jnp.asarray(weights, jnp.float32)


def velocities(pushes: Pushes, alpha=0.16, weights=CHARACTER.column_weight):
    """`velocity` in numpy: ud and delta_qdd [BATCH, 42]."""
    ud, delta_qdd = velocity(
        pushes.J, pushes.inverse, pushes.force, *spread(alpha, weights)
    )
    return np.asarray(ud), np.asarray(delta_qdd)


def alone(rows: list[list[float]]) -> np.ndarray:
    """A small matrix [r, n] padded with zeros to a batch, [BATCH, r, 42]."""
    padded = np.zeros((BATCH, len(rows), MODEL.nv), np.float32)
    padded[:, :, : len(rows[0])] = rows
    return padded


def test_velocity_of_a_pendulum_by_hand():
    # A point mass of 2 kg at the end of a 0.5 m rod, pushed across it with 10 N.
    length, mass, force, alpha = 0.5, 2.0, 10.0, 0.16
    J = alone([[0.0], [length], [0.0]])
    inverse = np.zeros((BATCH, MODEL.nv, MODEL.nv), np.float32)
    inverse[:, 0, 0] = 1.0 / (mass * length**2)
    pushes = Pushes(J, inverse, np.tile(np.float32([0.0, force, 0.0]), (BATCH, 1)))
    ud, _ = velocities(pushes, alpha, np.ones(MODEL.nv))
    exact = alpha / 600.0 * force / (mass * length)
    damped = length**2 / (length**2 + 1e-4)
    np.testing.assert_allclose(ud[0, 0], exact * damped**2, rtol=1e-6)
    np.testing.assert_array_equal(ud[0, 1:], 0.0)


def test_point_yields_by_alpha_whatever_the_weights():
    J = random_pushes(0, 100.0).J
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.2, 3.0, (BATCH, MODEL.nv)).astype(np.float32)
    xd = rng.normal(size=(BATCH, 3)).astype(np.float32)
    ud = measured_velocity(J, xd, *spread(0.3, weights))
    point = np.einsum("bij,bj->bi", J, ud)
    np.testing.assert_allclose(point, 0.3 * xd, atol=1e-3)


def test_joint_of_twice_the_weight_turns_twice_as_far():
    J = alone([[0.3, 0.3], [0.0, 0.0], [0.0, 0.0]])
    xd = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (BATCH, 1))
    weights = np.r_[2.0, np.ones(MODEL.nv - 1)]
    twice, once = measured_velocity(J, xd, *spread(1.0, weights))[0, :2]
    assert twice == pytest.approx(2.0 * once)
    assert 0.3 * (twice + once) == pytest.approx(1.0, rel=1e-3)


def test_columns_of_weight_zero_are_never_displaced():
    ud, _ = velocities(random_pushes(1, 180.0))
    np.testing.assert_array_equal(ud[:, 2:6], 0.0)
    assert np.all(np.abs(ud[:, :2]).max(axis=0) > 0.0)


def random_weights(rng: np.random.Generator) -> np.ndarray:
    """Of the columns [42], over four decades, from none to all of them zero."""
    weights = 10.0 ** rng.uniform(-3.0, 1.0, MODEL.nv)
    return weights * (rng.random(MODEL.nv) < rng.random())


@jax.jit
def powers(J, inverse, forces, weights):
    """f . (J ud) over its value for S = 1, at alpha = 1, [26 directions, 15 bodies]."""
    coords = quat.Coordinates.of(MODEL)  # its own, jax caches index arrays by precision
    rest = compliance.at_rest(coords)
    plain = compliance.Controller(CONFIG, coords, weights, DT, np.ones(MODEL.nv))

    def power(J, force):
        given = plain, rest, J[None], force[None], 1.0, None
        ud = compliance.algorithm_1(*given, lambda qfrc: qfrc @ inverse).ud
        yielding = J.T @ force
        return force @ (J @ ud) / (H * yielding @ (inverse @ yielding))

    each_body = jax.vmap(power, (0, None))
    return jax.vmap(each_body, (None, 0))(J, forces)


@pytest.mark.parametrize("double", [True, False])
def test_no_body_yields_against_the_force_in_any_clip_whatever_the_weights(double):
    rng, dtype = np.random.default_rng(9), np.float64 if double else np.float32
    directions = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0
    bodies = range(1, MODEL.nbody)
    chest, horizontal = CHARACTER.body_names.index("chest"), directions[:, 2] == 0.0
    with jax.enable_x64(double):
        for path in sorted(asset_path("motions").glob("*.npz")):
            poses = load_clip(path).qpos
            for frame in np.linspace(0, len(poses) - 1, 4).astype(int):
                J, inverse = mechanics(poses[frame], bodies, centres=True)
                for weights in (CHARACTER.column_weight, random_weights(rng)):
                    given = (J, inverse, 100.0 * directions, weights)
                    power = np.asarray(powers(*(np.asarray(x, dtype) for x in given)))
                    assert power.min() > (-1e-9 if double else -1e-4)
                    if weights is CHARACTER.column_weight:
                        assert power[horizontal, chest].min() > 0.1


def test_forces_add_up_and_vmap_is_a_loop():
    pushes = random_pushes(2, 100.0)
    each, _ = velocities(pushes)
    alpha = jnp.asarray(0.16, jnp.float32)
    for first in range(0, 10, 2):
        pair = slice(first, first + 2)

        def mass_solve(qfrc, inverse=pushes.inverse[pair]):
            return jnp.einsum("fi,fij->fj", qfrc, inverse)

        given = controller(), REST, pushes.J[pair], pushes.force[pair], alpha, None
        np.testing.assert_allclose(
            compliance.algorithm_1(*given, mass_solve).ud,
            each[pair].sum(axis=0),
            rtol=1e-4,
            atol=1e-7,
        )


def test_velocity_by_measurement_and_by_dynamics_agree_on_the_same_motion():
    pushes = random_pushes(3, 100.0)
    ud, delta_qdd = velocities(pushes)
    xd = H * np.einsum("bij,bj->bi", pushes.J, delta_qdd)
    measured = measured_velocity(pushes.J, xd, *spread(0.16, CHARACTER.column_weight))
    np.testing.assert_allclose(measured, ud, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("newtons", [0.0, 1e-9, 1.0, 180.0, 1e6])
@pytest.mark.parametrize("uneven", [False, True])
def test_velocity_never_exceeds_alpha_h_delta_qdd(newtons, uneven):
    weights = CHARACTER.column_weight
    if uneven:
        weights = 10.0 ** np.random.default_rng(4).uniform(-2, 2, (BATCH, MODEL.nv))
    ud, delta_qdd = velocities(random_pushes(4, newtons), 0.16, weights)
    ud, delta_qdd = ud.astype(float), delta_qdd.astype(float)
    bound = 0.16 * H * np.linalg.norm(delta_qdd, axis=1)
    assert np.all(np.linalg.norm(ud, axis=1) <= bound * (1.0 + 1e-5))
    assert np.all(np.any(ud != 0.0, axis=1)) == (newtons > 0.0)


@pytest.mark.parametrize("newtons", [0.0, 1e-9, 180.0, 1e6])
def test_displacement_at_singular_poses_stays_finite_and_bounded(newtons):
    hand = 1 + CHARACTER.body_names.index("left_hand")
    chest = 1 + CHARACTER.body_names.index("chest")
    cases = [
        (MODEL.qpos0, hand, np.array([0.0, newtons, 0.0])),  # along the arm
        (MODEL.qpos0, chest, np.array([0.0, 0.0, newtons])),  # along the spine
        (MODEL.qpos0, 1, np.array([0.0, 0.0, newtons])),  # the root, upwards
    ]
    pushes = Pushes.of(cases)
    uds, _ = velocities(pushes)
    for case, ud in enumerate(uds[: len(cases)]):
        delta_qdd = pushes.inverse[case] @ (pushes.J[case].T @ pushes.force[case])
        bound = 0.16 * H * np.linalg.norm(delta_qdd.astype(float))
        assert np.linalg.norm(ud.astype(float)) <= bound * (1.0 + 1e-5)
        displacement, _ = course(REST, ud, STEPS, DT)
        chex.assert_tree_all_finite(displacement)
        farthest = bound * STEPS * DT
        assert np.abs(displacement.u[:3]).max() <= farthest * (1.0 + 1e-4)
        norms = np.linalg.norm(np.asarray(displacement.u)[COORDS.quat_qpos], axis=1)
        np.testing.assert_allclose(norms, 1.0, atol=1e-5)


def test_level_zero_is_exactly_inert():
    for ud in velocities(random_pushes(5, 1e6), alpha=0.0)[0][:5]:
        displacement, _ = course(REST, ud, STEPS // 2, DT)
        chex.assert_trees_all_equal(displacement, REST)


def test_no_force_decays_to_the_reference_and_takes_the_velocity_along():
    _, path = course(REST, jnp.ones(MODEL.nv), 1, DT)
    np.testing.assert_allclose(path[0], DT, rtol=1e-4)
    path = np.asarray(path)
    # Critically damped from x = 0 with v = 1: x = t exp(-w t), largest 1 / (e w).
    for dof, stiffness_ in ((0, 60.0), (10, 100.0)):
        peak = 1.0 / (math.e * math.sqrt(stiffness_))
        assert path[:, dof].max() == pytest.approx(peak, rel=0.1)
    assert np.abs(path[-1]).max() < 1e-4
    assert path.min() > -1e-5


@pytest.mark.parametrize("dt", [1e-4, 1.0 / 30.0, 1.0, 1e3])
def test_return_is_stable_at_any_step(dt):
    tangent = jnp.asarray(np.random.default_rng(6).normal(0.0, 1.0, MODEL.nv))
    displacement = dataclasses.replace(
        REST,
        u=quat.exp_map(COORDS, tangent).astype(jnp.float32),
        ud=jnp.asarray(10.0 * tangent, jnp.float32),
    )
    _, path = course(displacement, jnp.zeros(MODEL.nv), 0, dt)
    assert np.abs(path).max() < 2.0 * np.abs(tangent).max()
    if dt >= 1.0 / 30.0:
        assert np.abs(path[-1]).max() < 1e-3


def test_only_forces_of_exactly_zero_do_not_act():
    assert not compliance.acting(jnp.zeros((4, 3)))
    assert compliance.acting(jnp.zeros((4, 3)).at[2, 1].set(-1e-9))


def test_a_force_of_exactly_zero_adds_nothing_to_another():
    pushes = random_pushes(10, 100.0)
    forces = pushes.force[:2] * np.float32([[1.0], [0.0]])
    xd = np.ones((2, 3), np.float32)
    given = controller(), REST, pushes.J[:2], forces, jnp.asarray(0.16), None
    both = compliance.measured(*given, xd).ud
    given = controller(), REST, pushes.J[:1], forces[:1], jnp.asarray(0.16), None
    np.testing.assert_allclose(both, compliance.measured(*given, xd[:1]).ud, rtol=1e-5)


def test_step_is_the_same_without_jit():
    pushes = random_pushes(7, 100.0)
    together, _ = velocities(pushes)
    given = controller(), REST, pushes.J[:1], pushes.force[:1], 0.16, None
    plain = compliance.algorithm_1(*given, lambda qfrc: qfrc @ pushes.inverse[0])
    np.testing.assert_allclose(together[0], plain.ud, rtol=1e-4, atol=1e-7)
    _, path = course(REST, together[0], 1, DT)
    np.testing.assert_allclose(
        quat.log_map(COORDS, plain.u), path[0], rtol=1e-4, atol=1e-7
    )


@pytest.mark.parametrize("root_dofs", [-1, MODEL.nv + 1])
def test_a_root_of_more_columns_than_there_are_is_refused(root_dofs):
    with pytest.raises(ValueError, match="root_dofs must be in"):
        ones = np.ones(MODEL.nv)
        compliance.Controller(CONFIG, COORDS, ones, DT, ones, root_dofs)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("law", "guessed"),
        ("response_time", 0.0),
        ("damping", -1e-4),
        ("joint_return_stiffness", math.inf),
        ("root_return_stiffness", math.nan),
    ],
)
def test_a_bad_constant_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        ComplianceConfig(**{name: value})


# A fixed-base arm of three hinges (J is square) and one of seven velocities.
HINGES = """
<mujoco><option timestep="0.003" gravity="0 0 0"/>
<default><joint damping="8" armature="0.01"/></default>
<worldbody><body name="base"><joint axis="0 0 1"/><geom size=".05" mass="1"/>
  <body name="upper"><joint axis="0 1 0"/><geom size=".04" pos=".2 0 0" mass="1.5"/>
    <body name="lower" pos=".4 0 0"><joint axis="0 1 0"/>
      <geom size=".04" pos=".2 0 0" mass="1"/>
</body></body></body></worldbody></mujoco>"""
BALLS = """
<mujoco><option timestep="0.003" gravity="0 0 0"/>
<default><joint damping="8" armature="0.01"/></default>
<worldbody><body name="upper"><joint type="ball"/>
  <geom size=".04" pos=".15 0 0" mass="1.5"/>
  <body name="middle" pos=".3 0 0"><joint axis="0 1 0"/>
    <geom size=".04" pos=".15 0 0" mass="1"/>
    <body name="lower" pos=".3 0 0"><joint type="ball"/>
      <geom size=".04" pos=".1 0 0" mass="0.5"/>
</body></body></body></worldbody></mujoco>"""
LEVELS = {
    "measured": (0.0, 0.04, 0.08, 0.16, 0.5),
    "admittance": (0.0, 0.16, 0.5, 0.8, 0.9),
}
KP = 100.0


@dataclass(frozen=True)
class Arm:
    model: mujoco.MjModel
    rest: np.ndarray  # tangent from qpos0 of the pose it is held in
    tip: tuple[float, float, float]  # on the body "lower", m
    weights: np.ndarray  # [nv]

    @property
    def q_m(self) -> np.ndarray:
        q = self.model.qpos0.copy()
        mujoco.mj_integratePos(self.model, q, self.rest, 1.0)
        return q


ARMS = {
    "three hinges": Arm(
        mujoco.MjModel.from_xml_string(HINGES),
        np.array([0.4, -0.5, 1.2]),
        (0.4, 0.0, 0.0),
        np.ones(3),
    ),
    "balls of unequal weights": Arm(
        mujoco.MjModel.from_xml_string(BALLS),
        np.array([0.3, -0.4, 0.5, 1.2, 0.3, 0.4, -0.6]),
        (0.2, 0.0, 0.0),
        np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0]),
    ),
}


def controllers(arm: Arm, law: str):
    """One step of the controllers of B arms.

    displacements, J, qvel, forces, alpha -> displacements, q_bar
    """
    coords, dt = quat.Coordinates.of(arm.model), arm.model.opt.timestep
    of_arm = compliance.Controller(
        CONFIG, coords, arm.weights, dt, np.full(arm.model.nv, KP), root_dofs=0
    )
    q_m = jnp.asarray(arm.q_m, jnp.float32)

    def step(displacement, J, qvel, force, alpha):
        if law == "measured":
            given = J[None], force[None], alpha, None, (J @ qvel)[None]
            displacement = compliance.measured(of_arm, displacement, *given)
        else:
            given = force @ J, alpha, None
            displacement = compliance.admittance(of_arm, displacement, *given)
        return displacement, quat.oplus(coords, q_m, displacement.u)

    return compliance.at_rest(coords), jax.jit(jax.vmap(step))


def simulated_rest(
    arm: Arm, law: str, forces: np.ndarray, levels: np.ndarray
) -> np.ndarray:
    """Where constant forces [B, 3] take the tip in 3 s of C MuJoCo, m [B, 3]."""
    model, body = arm.model, arm.model.body("lower").id
    start, step = controllers(arm, law)
    displacement = jax.tree.map(lambda x: jnp.tile(x, (len(forces), 1)), start)
    q_bar = np.tile(arm.q_m, (len(forces), 1))
    runs = [mujoco.MjData(model) for _ in forces]
    J = np.zeros((len(forces), 3, model.nv))
    tips, error = np.zeros((len(forces), 3)), np.zeros(model.nv)
    for data in runs:
        data.qpos[:] = arm.q_m
        mujoco.mj_forward(model, data)
    began = _tip(runs[0], body, arm.tip)
    for _ in range(1000):
        for i, data in enumerate(runs):
            tips[i] = _tip(data, body, arm.tip)
            mujoco.mj_jac(model, data, J[i], None, tips[i], body)
            mujoco.mj_differentiatePos(model, error, 1.0, data.qpos, q_bar[i])
            data.qfrc_applied[:] = KP * error + J[i].T @ forces[i]
            mujoco.mj_step(model, data)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
        qvel = np.stack([data.qvel for data in runs]).astype(np.float32)
        displacement, target = step(
            displacement, J.astype(np.float32), qvel, forces.astype(np.float32), levels
        )
        q_bar = np.asarray(target, float)
    assert max(np.abs(data.qvel).max() for data in runs) < 1e-3
    return tips - began


def _tip(data: mujoco.MjData, body: int, point: tuple[float, float, float]):
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(point)


def simulated_stiffness(arm: Arm, law: str, size: float) -> dict[float, np.ndarray]:
    """K_hat [3, 3] at every level, from the yield to forces of `size` N."""
    levels = LEVELS[law]
    signed = size * np.concatenate([np.eye(3), -np.eye(3)])
    forces = np.tile(signed, (len(levels), 1))
    # The same yield at every level: a stiffness is that of small displacements.
    shares = np.repeat(np.array(levels, np.float32), 6)
    forces = forces * (1.0 - shares[:, None])
    tips = simulated_rest(arm, law, forces, shares).reshape(len(levels), 2, 3, 3)
    return {
        alpha: np.linalg.inv((plus - minus).T / (2.0 * size * (1.0 - alpha)))
        for alpha, (plus, minus) in zip(levels, tips, strict=True)
    }


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def small_force(K: np.ndarray) -> float:
    """N, that moves a point of stiffness K by about a centimetre."""
    return 0.01 * np.sqrt(np.linalg.eigvalsh(K)[0] * np.linalg.eigvalsh(K)[1])


@pytest.mark.parametrize("name", ARMS)
def test_simulated_static_stiffness_is_kp_one_minus_alpha_L(name):
    arm = ARMS[name]
    K = stiffness(arm.model, arm.q_m, "lower", arm.tip, KP)
    for alpha, K_hat in simulated_stiffness(arm, "measured", small_force(K)).items():
        assert off(K_hat, modulated_stiffness(K, alpha)) < (0.02 if alpha else 0.01)
        ratio = determinant(0.5 * (K_hat + K_hat.T)) / determinant(K)
        assert ratio == pytest.approx((1.0 - alpha) ** 3, rel=0.04)


@pytest.mark.parametrize("name", ARMS)
def test_admittance_has_the_stiffness_of_the_softened_gains_at_any_level(name):
    arm = ARMS[name]
    kp = np.full(arm.model.nv, KP)
    K = stiffness(arm.model, arm.q_m, "lower", arm.tip, KP)
    found = simulated_stiffness(arm, "admittance", small_force(K))
    for alpha, K_hat in found.items():
        soft = softened_gains(kp, arm.weights, alpha)
        assert off(K_hat, stiffness(arm.model, arm.q_m, "lower", arm.tip, soft)) < 0.01
        if np.all(arm.weights == 1.0):
            assert off(K_hat, modulated_stiffness(K, alpha)) < 0.01


def test_delta_qdd_is_the_difference_of_two_forward_passes_of_mjx():
    # An arm, because the character's forward pass compiles for half a minute.
    arm, rng = ARMS["balls of unequal weights"], np.random.default_rng(8)
    c_data = mujoco.MjData(arm.model)
    c_data.qpos[:] = arm.q_m
    mujoco.mj_forward(arm.model, c_data)
    body = arm.model.body("lower").id
    J, delta_qdd = np.zeros((3, arm.model.nv)), np.zeros((1, arm.model.nv))
    mujoco.mj_jac(arm.model, c_data, J, None, _tip(c_data, body, arm.tip), body)
    torque = J.T @ np.array([30.0, -120.0, 60.0])
    mujoco.mj_solveM(arm.model, c_data, delta_qdd, torque[None])
    model = mjx.put_model(arm.model)
    data = mjx.make_data(model).replace(
        qpos=jnp.asarray(arm.q_m, jnp.float32),
        qvel=jnp.asarray(rng.normal(0.0, 1.0, arm.model.nv), jnp.float32),
    )

    @jax.jit
    @jax.vmap
    def accelerations(applied):
        return mjx.forward(model, data.replace(qfrc_applied=applied)).qacc

    applied = jnp.asarray(np.stack([torque, np.zeros_like(torque)]), jnp.float32)
    with_force, without = np.asarray(accelerations(applied), float)
    scale = np.abs(with_force).max()
    np.testing.assert_allclose(with_force - without, delta_qdd[0], atol=1e-5 * scale)
