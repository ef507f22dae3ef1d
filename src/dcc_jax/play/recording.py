"""What is kept of an episode: numbers of each control step, and what pictures need.

Letters: N episodes, T control steps, S physics steps in one, F forces, C chunks of
control steps, E coordinates of a style pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import physics, quat
from dcc_jax.env import mechanics
from dcc_jax.env.environment import Environment
from dcc_jax.env.state import EnvState
from dcc_jax.env.task import Forces

Array = jax.Array


@flax.struct.dataclass
class Motion:
    """What a picture needs, of the strongest moment of each control step."""

    qpos: Array  # [..., nq] of the scene at the end of the control step
    u: Array  # [..., 55]
    reference: Array  # [..., 55] q_m(t), where the task follows its clip in time
    force_w: Array  # [..., F, 3] N, passed to the compliance controller
    point_w: Array  # [..., F, 3] m
    mocap_pos: Array  # [..., nmocap, 3] m, of the scene's kinematic bodies
    mocap_quat: Array  # [..., nmocap, 4]


@flax.struct.dataclass
class Frame:
    """What is kept of a control step of one environment."""

    numbers: dict[str, Array]  # [] each
    motion: Motion
    terminated: Array  # [] bool
    truncated: Array  # [] bool, by the end of a clip that is followed
    nan: Array  # [] bool


@dataclass(frozen=True)
class Recording:
    """N episodes; what comes after the end of one is not alive."""

    alive: np.ndarray  # [T, N] bool, the control step belongs to the episode
    fell: np.ndarray  # [N] bool, it ended by termination
    nan: np.ndarray  # [N] bool, it ended because the physics broke
    numbers: dict[str, np.ndarray]  # [T, N] each
    motion: Motion | None  # [T, N, ...], where it was asked for
    pairs: np.ndarray  # [C, N, E] m, style coordinates at the end of each chunk
    pairs_alive: np.ndarray  # [C, N] bool


def frame(
    environment: Environment,
    before: EnvState,
    state: EnvState,
    forces: Forces,
) -> Frame:
    """The record of a control step of ONE environment.

    Args:
        environment: of the episode.
        before: the state at the beginning of the control step.
        state: at its end.
        forces: of its physics steps, leaves [S, ...].
    """
    return Frame(
        numbers=_numbers(environment, before, state),
        motion=_motion(environment, state, forces),
        terminated=state.terminated,
        truncated=state.truncated,
        nan=state.nan,
    )


def _numbers(
    environment: Environment, before: EnvState, state: EnvState
) -> dict[str, Array]:
    """Everything of a control step that is one number; `measures` sums them up."""
    scene, task, tables = environment.scene, environment.task, environment.mechanics
    q = scene.character_qpos(state.body.qpos)
    kinetic, potential = mechanics.energy(
        tables, q, scene.character_qvel(state.body.qvel)
    )
    soles = mechanics.sole_points(tables, q)
    slip, stands = mechanics.slip(
        soles,
        mechanics.sole_points(tables, scene.character_qpos(before.body.qpos)),
        task.ground_height(scene, state.task, state.body),
        task.ground_height(scene, before.task, before.body),
    )
    own = task.evaluate(scene, state.task, state.body)
    metrics = state.metrics
    numbers = {
        "force_peak": metrics.force_peak,
        "impulse": metrics.impulse,
        "contact_share": metrics.contact_share,
        "torque_rms": metrics.torque_rms,
        "contact_torque": metrics.contact_torque,
        "torque_peak": metrics.torque_peak,
        "power": metrics.power,
        "displacement": metrics.displacement,
        "root_displacement": metrics.root_displacement,
        "kinetic": kinetic,
        "energy": kinetic + potential,
        "foot_height": jnp.min(soles[:, 2]),
        "pelvis_height": q[2],
        "slip": slip,
        "stands": stands,
        "range_excess": jnp.max(mechanics.range_excess(tables, q)),
        "r_q": state.r_q,
        "r_p": state.r_p,
        "r_task": state.r_task,
    }
    numbers |= {f"task/{name}": value for name, value in own.items()}
    return {k: jnp.asarray(v, jnp.float32) for k, v in numbers.items()}


def _motion(environment: Environment, state: EnvState, forces: Forces) -> Motion:
    heard = jnp.where(forces.gate[:, None, None], forces.force_w, 0.0)
    strongest = jnp.argmax(jnp.sum(heard**2, axis=(1, 2)))
    scene = environment.scene
    world = environment.task.world(scene, state.task, state.time)
    world = physics.default_world(scene) if world is None else world
    return Motion(
        qpos=state.body.qpos,
        u=state.displacement.u,
        reference=state.reference.qpos,
        force_w=heard[strongest],
        point_w=forces.point_w[strongest],
        mocap_pos=world.mocap_pos,
        mocap_quat=world.mocap_quat,
    )


def displaced(environment: Environment, motion: Motion) -> np.ndarray:
    """The ghost of a motion: scene coordinates [..., nq] that show u.

    Where the task follows its clip in time, the displaced reference q_m(t) (+) u. Else
    the reference has no time, and the ghost is the pose q (-) u that the discriminator
    judges: what the character would do without u, the gap between the two being u.
    """
    return np.asarray(_displaced(environment, motion))


@partial(jax.jit, static_argnums=0)
def _displaced(environment: Environment, motion: Motion) -> Array:
    scene, coords = environment.scene, environment.kinematics.coords
    qpos = jnp.asarray(motion.qpos)
    if environment.tracks_reference:
        ghost = quat.oplus(coords, motion.reference, motion.u)
    else:
        ghost = quat.ominus(coords, scene.character_qpos(qpos), motion.u)
    end = scene.qpos_adr + scene.character.nq
    return qpos.at[..., scene.qpos_adr : end].set(ghost)
