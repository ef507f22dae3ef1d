"""How far contact forces are from converged C MuJoCo, where feet land.

Quiet standing hides the error. So characters fall from 0.3 m in slightly different
poses; ours and C start from the same state in every step of the first 0.2 s after
touchdown. Letters: D drops.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics
from dcc_jax.character import FEET
from dcc_jax.control import pd

Array = jax.Array
FALL, LANDING = 0.75, 0.2  # s, of a drop; measured after touchdown
HEIGHT, TURN = 0.3, 0.1  # m; rad, deviation of the joints
LEAST = 1.0  # N; smaller forces are left out


@dataclass
class Landing:
    """What is collected of all drops."""

    since: np.ndarray  # [D] steps since touchdown, -1: in the air
    ours: np.ndarray  # [D, 2] N, sum over steps of each foot's force
    theirs: np.ndarray  # [D, 2] N
    errors: list[float] = field(default_factory=list)  # relative, foot by foot


def landing_errors(scene: physics.Scene, drops: int) -> dict[str, float]:
    """Relative error of each foot's force and of the impulse, against converged C."""
    model = copy.copy(scene.model)
    model.opt.iterations, model.opt.tolerance = 100, 1e-12
    data, feet = mujoco.MjData(model), [scene.body(name) for name in FEET]
    slots = [scene.contact_bodies[:, 1] == foot for foot in feet]
    states, step = _falling(scene, drops), _step(scene)
    sums = np.zeros((drops, 2))
    landing = Landing(np.full(drops, -1), sums, sums.copy())
    for _ in range(int(FALL / scene.timestep)):
        following, force, qfrc = step(states)
        force, qfrc = np.asarray(force), np.asarray(qfrc)
        for i in range(drops):
            data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
            data.qfrc_applied[:] = qfrc[i]
            mujoco.mj_forward(model, data)
            mine = np.array([force[i, slot].sum(axis=0) for slot in slots])
            _compare(landing, i, mine, _foot_forces(model, data, feet), scene.timestep)
        states = following
    return _summary(landing)


def _falling(scene: physics.Scene, drops: int) -> physics.State:
    """Characters at rest in the air, [D, ...]."""
    model, rng = scene.model, np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (drops, 1))
    for row in qpos:
        tangent = np.r_[0, 0, HEIGHT, TURN * rng.normal(size=model.nv - 3)]
        mujoco.mj_integratePos(model, row, tangent, 1.0)
    still = jnp.zeros(model.nv)
    return jax.vmap(lambda q: physics.initial_state(scene, q, still))(
        jnp.asarray(qpos, jnp.float32)
    )


def _step(scene: physics.Scene):
    """Of all drops: state -> next state, contact forces, torques of a PD to qpos0."""

    @jax.jit
    @jax.vmap
    def step(state: physics.State) -> tuple[physics.State, Array, Array]:
        target = jnp.asarray(scene.model.qpos0, state.qpos.dtype)
        character = scene.character
        tau = pd.torque(character, state.qpos, state.qvel, target, scene.timestep)
        kin = physics.kinematics(scene, state)
        solution = physics.solve(scene, kin, state, tau)
        return (
            physics.integrate(scene, state, solution),
            solution.contact_force_w,
            tau,
        )

    return step


def _compare(
    landing: Landing, drop: int, ours: np.ndarray, theirs: np.ndarray, timestep: float
) -> None:
    """Notes the feet's forces [2, 3] of a step, N."""
    landing.since[drop] += int(landing.since[drop] >= 0 or theirs.any())
    if not 0 <= landing.since[drop] < LANDING / timestep:
        return
    size = np.linalg.norm(theirs, axis=1)
    gap = np.linalg.norm(ours - theirs, axis=1)
    stands = size > LEAST
    landing.errors += list(gap[stands] / size[stands])
    landing.ours[drop] += np.linalg.norm(ours, axis=1)
    landing.theirs[drop] += size


def _summary(landing: Landing) -> dict[str, float]:
    landed = landing.theirs > 0.0
    impulse = np.abs(landing.ours - landing.theirs)[landed] / landing.theirs[landed]
    return {
        "force_error_median": float(np.median(landing.errors)),
        "force_error_p95": float(np.percentile(landing.errors, 95)),
        "force_error_max": float(np.max(landing.errors)),
        "impulse_error_median": float(np.median(impulse)),
    }


def _foot_forces(
    model: mujoco.MjModel, data: mujoco.MjData, feet: list[int]
) -> np.ndarray:
    """World force [2, 3] of the floor on each foot."""
    total, local = np.zeros((2, 3)), np.zeros(6)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, local)
        foot = feet.index(model.geom_bodyid[data.contact[i].geom2])
        total[foot] += data.contact[i].frame.reshape(3, 3).T @ local[:3]
    return total
