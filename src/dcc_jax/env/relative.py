"""How fast points of the character move against its reference (Eq. (8)).

Written for ONE environment. F points, each fixed to a body.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT
from dcc_jax.env import features
from dcc_jax.env.features import Kinematics
from dcc_jax.env.state import ControlInputs, Substep
from dcc_jax.env.task import Forces
from dcc_jax.motion.reference import RefState

Array = jax.Array


def velocity(
    scene: physics.Scene,
    kinematics: Kinematics,
    carry: Substep,
    inputs: ControlInputs,
    J: Array,
    forces: Forces,
) -> Array:
    """Velocities [F, 3] of the forces' points less the reference's, m/s, world.

    Args:
        scene: of the character.
        kinematics: of the character.
        carry: at the beginning of the physics step.
        inputs: of the control step.
        J: Jacobians of the points [F, 3, 42].
        forces: with their points and bodies.
    """
    q = scene.character_qpos(carry.body.qpos)
    qd = scene.character_qvel(carry.body.qvel)
    share = (carry.time - inputs.time) / CONTROL_DT
    begin, end = inputs.reference_before, inputs.reference
    q_m, qd_m = between(kinematics.coords, begin, end, share)
    body = jnp.asarray(_character_body(scene))[forces.body]
    local = local_points(kinematics, q, forces.point_w, body)
    u = carry.displacement.u
    reference = reference_velocity(kinematics, q_m, qd_m, u, local, body)
    return jnp.sum(J * qd, axis=-1) - reference


def _character_body(scene: physics.Scene) -> np.ndarray:
    """Which of the character's 15 bodies each body of the scene is, 0 for others."""
    model, names = scene.model, scene.character.body_names
    root = model.body(model.dof_bodyid[scene.dof_adr]).name
    prefix = root.removesuffix(names[0])
    index = np.zeros(model.nbody, int)
    for i, name in enumerate(names):
        index[scene.body(prefix + name)] = i
    return index


def between(
    coords: quat.Coordinates, begin: RefState, end: RefState, share: Array
) -> tuple[Array, Array]:
    """q_m [55] and its velocity [42] within a control step.

    Args:
        coords: of the character.
        begin: the reference at the beginning of the control step.
        end: and at its end.
        share: of the control step that has passed [], 0 to 1.
    """
    scalars, quats = coords.split_q(begin.qpos)
    later_scalars, later_quats = coords.split_q(end.qpos)
    q_m = coords.join_q(
        scalars + share * (later_scalars - scalars),
        quat.slerp(quats, later_quats, share),
    )
    return q_m, begin.qvel + share * (end.qvel - begin.qvel)


def local_points(
    kinematics: Kinematics, q: Array, point_w: Array, body: Array
) -> Array:
    """World points [F, 3] in the frames of their bodies, m, the character being at q.

    Args:
        kinematics: of the character.
        q: its coordinates [55].
        point_w: m, world [F, 3].
        body: which of its 15 bodies each is fixed to [F].
    """
    pos_w, quat_w = features.body_poses(kinematics, q)
    return quat.rotate(quat.inv(quat_w[body]), point_w - pos_w[body])


def reference_velocity(
    kinematics: Kinematics, q_m: Array, qd_m: Array, u: Array, local: Array, body: Array
) -> Array:
    """Velocities [F, 3] of points of q_m(t) (+) u, m/s, world; u is at rest.

    Eq. (6) asks for the displacement against q_m, so that u's own velocity counts as
    the character's: less it as well, the share alpha would become alpha / (1 + alpha).

    Args:
        kinematics: of the character.
        q_m: the reference [55].
        qd_m: its velocity [42].
        u: displacement [55].
        local: the points in the frames of their bodies [F, 3], m.
        body: which of the 15 bodies each is fixed to [F].
    """
    coords = kinematics.coords

    def points(time: Array) -> Array:
        q = quat.oplus(coords, quat.integrate(coords, q_m, qd_m, time), u)
        pos_w, quat_w = features.body_poses(kinematics, q)
        return pos_w[body] + quat.rotate(quat_w[body], local)

    zero = jnp.zeros((), q_m.dtype)
    return jax.jvp(points, (zero,), (jnp.ones_like(zero),))[1]
