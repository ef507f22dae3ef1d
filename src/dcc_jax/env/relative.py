"""How fast points of the character move against its reference (Eq. 8).

Written for ONE environment. F points, each fixed to a body.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dcc_jax import quat
from dcc_jax.env import features
from dcc_jax.env.features import Kinematics
from dcc_jax.motion.reference import RefState

Array = jax.Array


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
