"""relative.py against C MuJoCo, and measured velocities through the environment."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT, Character, asset_path, compose_scene
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.control.stiffness import modulated_stiffness, softened_gains, stiffness
from dcc_jax.env import features, relative
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.task import Forces, Task, place_character
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.reference import References, make_references
from dcc_jax.tasks.push import Push

BODIES = ("pelvis", "chest", "head", "left_hand", "right_foot")
MEASURED = ComplianceConfig(law="measured")


def loaded(names: tuple[str, ...]) -> References:
    return make_references([load_clip(asset_path(f"motions/{n}.npz")) for n in names])


def test_velocity_of_the_displaced_reference_is_mujocos(character):
    model = compose_scene(character, floor=False)
    kinematics, data = features.Kinematics.of(model), mujoco.MjData(model)
    coords, rng, rows, expected = kinematics.coords, np.random.default_rng(0), [], []
    for body in (0, 5, 14):
        q_m = model.qpos0.copy()
        mujoco.mj_integratePos(model, q_m, rng.normal(0.0, 0.5, model.nv), 1.0)
        u, qd_m = model.qpos0.copy(), rng.normal(size=model.nv)
        mujoco.mj_integratePos(model, u, rng.normal(0.0, 0.5, model.nv), 1.0)
        # The velocity of q_m (+) u while u is at rest: its tangents turn with u^-1.
        qd, turned = qd_m.copy(), np.zeros(4)
        for joint, dofs in zip(coords.quat_qpos, coords.quat_dof, strict=True):
            mujoco.mju_negQuat(turned, u[joint])
            mujoco.mju_rotVecQuat(qd[dofs[0] : dofs[0] + 3], qd_m[dofs], turned)
        data.qpos[:] = quat.oplus(coords, q_m, u)
        mujoco.mj_forward(model, data)
        local, J = rng.normal(size=3), np.zeros((3, model.nv))
        point_w = data.xpos[1 + body] + data.xmat[1 + body].reshape(3, 3) @ local
        mujoco.mj_jac(model, data, J, None, point_w, 1 + body)
        rows.append((q_m, qd_m, u, data.qpos.copy(), point_w[None], np.array([body])))
        expected.append((local, J @ qd))

    @jax.jit
    @jax.vmap
    def found(q_m, qd_m, u, q, point_w, body):
        local = relative.local_points(kinematics, q, point_w, body)
        return local[0], relative.reference_velocity(
            kinematics, q_m, qd_m, u, local, body
        )[0]

    columns = (jnp.asarray(np.stack(x)) for x in zip(*rows, strict=True))
    for ours, theirs in zip(found(*columns), zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@dataclass(frozen=True)
class Followed(Task):
    """Aloft, following its clip in time; no force is reported."""

    follows_reference: ClassVar[bool] = True

    @property
    def has_floor(self) -> bool:
        return False


def test_a_runner_on_its_reference_is_not_displaced_by_any_force(character):
    """At alpha 1, in the middle of a control step, pushed at each of `BODIES`."""
    environment = Environment(
        Followed(),
        character,
        loaded(("walk_cycle", "run_cycle")),
        EnvConfig(compliance=MEASURED),
    )
    scene, coords = environment.scene, environment.kinematics.coords
    ids = jnp.array([scene.body(name) for name in BODIES])

    @jax.jit
    @jax.vmap
    def pushed(key, beside):
        """ud [bodies, 42] and the velocity of the root."""
        reset_key, step_key = jax.random.split(key)
        state = environment.reset(reset_key, jnp.ones(()))
        action = jnp.zeros(environment.action_size)
        carry, plan = environment.begin(step_key, state, action)
        middle = state.time + 0.5 * CONTROL_DT
        q_m, qd_m = relative.between(coords, state.reference, plan.reference, 0.5)
        body = physics.initial_state(scene, q_m, qd_m.at[1].add(beside))
        carry = dataclasses.replace(carry, body=body, time=middle)
        kin = physics.kinematics(scene, body)

        def displaced(body):
            force, point = jnp.array([[0.0, 80.0, 0.0]]), kin.body_center[body]
            forces = Forces(force, point[None], body[None], jnp.ones((), bool))
            return environment.side.displaced(carry, plan, kin, forces).ud

        return jax.vmap(displaced)(ids), jnp.linalg.norm(qd_m[:2])

    def drawn():
        return jax.random.split(jax.random.key(0), 24)

    ud, speeds = pushed(drawn(), jnp.zeros(24))
    assert speeds.max() > 2.5
    assert np.abs(ud).max() < 2e-3
    # What the character does beside its reference it yields to, and no more.
    ud, _ = pushed(drawn(), jnp.full(24, 0.3))
    pelvis = ud[:, BODIES.index("pelvis"), :2]
    np.testing.assert_allclose(pelvis, np.tile([0.0, 0.3], (24, 1)), atol=2e-3)


def test_measured_velocities_without_a_reference_in_time_are_refused(character):
    config = EnvConfig(compliance=MEASURED)
    with pytest.raises(
        ValueError, match=r"env\.compliance\.law must be .*'push'.* got 'measured'"
    ):
        Environment(Push(), character, loaded(("stand",)), config)


@flax.struct.dataclass
class Pulled:
    force_w: jax.Array  # [3] N


@dataclass(frozen=True)
class HeldAndPulled(Task):
    """A force pulls at the hand; weightless, the pelvis held by 1e8 kg and kg m^2.

    A weld would give way by a tenth of what the stiffest direction of the hand does.
    """

    follows_reference: ClassVar[bool] = True

    @property
    def has_floor(self) -> bool:
        return False

    newtons: float = 100.0

    def extend(self, spec: mujoco.MjSpec) -> None:
        spec.option.gravity = [0.0, 0.0, 0.0]
        spec.joint("root").armature = 1e8

    def reset(self, key, scene, reference):
        return Pulled(jnp.zeros(3)), *place_character(scene, reference)

    def applied(self, scene, state, kin, time):
        hand = scene.body("left_hand")
        J = physics.point_jacobian(scene, kin, kin.body_pos[hand], jnp.asarray(hand))
        return state.force_w @ J

    def forces(self, scene, state, kin, solution, action):
        hand = scene.body("left_hand")
        return state, Forces(
            force_w=state.force_w[None],
            point_w=kin.body_pos[hand][None],
            body=jnp.array([hand]),
            gate=jnp.ones((), bool),
        )


def stiff(character: Character) -> Character:
    """Thirty times the gains: 100 N then move a hand by less than a centimetre. No root
    columns: nothing drives a root that is held."""
    weights = character.column_weight.copy()
    weights[:6] = 0.0
    return dataclasses.replace(
        character,
        kp=30.0 * character.kp,
        kv=30.0 * character.kv,
        torque_limit=np.full_like(character.torque_limit, 1e6),
        column_weight=weights,
    )


@pytest.mark.parametrize("law", ["measured", "admittance"])
def test_static_stiffness_through_the_environment_is_kp_one_minus_alpha_L(
    character, law
):
    levels, forces = np.array([0.0, 0.16, 0.5]), np.concatenate([np.eye(3), -np.eye(3)])
    task, character = HeldAndPulled(), stiff(character)
    pose = load_clip(asset_path("motions/run_cycle.npz")).qpos[5].copy()
    pose[:7] = compose_scene(character, floor=False).qpos0[:7]
    still = Clip(name="still", qpos=np.tile(pose, (90, 1)), fps=30.0, loop=True)
    environment = Environment(
        task,
        character,
        make_references([still]),
        EnvConfig(compliance=ComplianceConfig(law=law)),
    )

    @jax.jit
    @jax.vmap
    def rest(alpha, force):
        """Where the hand is after 3 s, and how fast it still goes."""
        key = jax.random.key(0)
        state = environment.reset(key, alpha)
        state = dataclasses.replace(state, task=Pulled(force))

        def step(state, _):
            action = jnp.zeros(environment.action_size)
            return environment.step(jax.random.key(1), state, action), None

        state, _ = jax.lax.scan(step, state, None, length=90)
        hand, _ = features.body_pose(state.body.qpos, "left_hand")
        return hand, jnp.abs(state.body.qvel).max()

    alphas = np.repeat(levels, 6).astype(np.float32)
    hands, speeds = rest(alphas, np.tile(task.newtons * forces, (3, 1)))
    assert speeds.max() < 1e-3
    K = stiffness(environment.scene.model, pose, "left_hand", kp=_gains(character))
    for alpha, (plus, minus) in zip(
        levels, np.asarray(hands, float).reshape(3, 2, 3, 3), strict=True
    ):
        K_hat = np.linalg.inv((plus - minus).T / (2.0 * task.newtons))
        expected = modulated_stiffness(K, float(alpha))
        if law == "admittance":  # whose joints of weight 2 are softer
            soft = softened_gains(
                _gains(character), character.column_weight, float(alpha)
            )
            expected = stiffness(environment.scene.model, pose, "left_hand", kp=soft)
        error = np.linalg.norm(K_hat - expected) / np.linalg.norm(expected)
        assert error < (0.01 if alpha == 0.0 else 0.02)


def _gains(character: Character) -> np.ndarray:
    """kp [42] with a number for the root, which `stiffness` leaves out."""
    return np.where(character.kp > 0.0, character.kp, 1.0)
