"""The room that the joint ranges leave to a displacement u of the reference q_m.

A joint's pose is its rotation vector r = log(q_m u), and its range a box of such
vectors. The room is the way from log(q_m) to the sides of the box. Where q_m itself is
outside, the box reaches out to it, so that u = 0 is always inside. Everything is
written for ONE environment. Letters: J ball joints, nq coordinates, nv velocities.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.control.small_matrix import times

Array = jax.Array

LINEAR_SHARE = 0.5
"""Of its room that a joint uses before a displacement is shortened. Up to there the
stiffness is what theory gives; beyond, u approaches the end of the room and never
reaches it."""
ROOT_ROOM = 0.6
"""m, of the root over the ground: a long step, from which the feet follow."""


@dataclass(frozen=True, eq=False)
class JointRanges:
    """Bounds of the rotation vectors of a model's last J ball joints."""

    lower: np.ndarray  # [J, 3] rad
    upper: np.ndarray  # [J, 3] rad

    def room(self, coords: quat.Coordinates, q_m: Array) -> Room:
        """What q_m [nq] leaves of the ranges."""
        pose = coords.split_q(q_m)[1][-len(self.lower) :]
        pose = jnp.where(pose[:, :1] < 0.0, -pose, pose)
        r = quat.log(pose)
        lower = jnp.minimum(jnp.asarray(self.lower, r.dtype), r)
        upper = jnp.maximum(jnp.asarray(self.upper, r.dtype), r)
        return Room(
            pose,
            r,
            lower,
            upper,
            per_lower=1.0 / jnp.maximum(r - lower, 1e-6),
            per_upper=1.0 / jnp.maximum(upper - r, 1e-6),
            turning=inverse_right_jacobian(r),
        )


@flax.struct.dataclass
class Room:
    """Of J joints, for one q_m."""

    pose: Array  # [J, 4] q_m, the real part not negative
    r: Array  # [J, 3] rad, log(q_m)
    lower: Array  # [J, 3] rad
    upper: Array  # [J, 3] rad
    per_lower: Array  # [J, 3] 1/rad, one over the way from r down to `lower`
    per_upper: Array  # [J, 3] 1/rad, one over the way from r up to `upper`
    turning: Array  # [J, 3, 3] Jr^-1(r)

    def used(self, way: Array) -> Array:
        """Share of its room [J] that a joint uses which is r + way, way [J, 3] rad."""
        shares = jnp.maximum(way * self.per_upper, -way * self.per_lower)
        return jnp.max(shares, axis=-1)

    def turned(self, u: Array) -> Array:
        """log(q_m u) [J, 3] of a displacement's quaternions [J, 4].

        Beyond half a turn it goes on growing.
        """
        return quat.long_log(quat.mul(self.pose, u))

    def turning_to(self, r: Array) -> Array:
        """The quaternions u [J, 4] with log(q_m u) = r, r [J, 3] rad."""
        return quat.mul(quat.inv(self.pose), quat.exp(r))


def bounded(coords: quat.Coordinates, room: Room, rest: Array) -> Array:
    """A displacement's tangent [nv] shortened so that it stays in the room.

    Each joint by a factor of its own, in (0, 1]: the direction in which it turns stays,
    and with it f . (J rest) >= 0. The joint's rotation vector is taken to first order,
    log(q_m exp(w)) = r + Jr^-1(r) w with Jr the right Jacobian of SO(3).

    Args:
        coords: of the character.
        room: of its q_m.
        rest: the root's part in m, rad elsewhere.
    """
    scalars, turns, joints = _parts(coords, room, rest)
    joints = joints * _shortened(used(coords, room, rest))[:, None]
    away = jnp.sqrt(jnp.sum(scalars**2) + 1e-12) / ROOT_ROOM
    return coords.join_v(scalars * _shortened(away), jnp.concatenate([turns, joints]))


def used(coords: quat.Coordinates, room: Room, tangent: Array) -> Array:
    """Share of its room [J] that each joint of a displacement's tangent [nv] uses.

    Nor can it use more than half a turn: PD goes to its target the short way.
    """
    _, _, joints = _parts(coords, room, tangent)
    half_turns = jnp.sqrt(jnp.sum(joints * joints, axis=-1)) / jnp.pi
    return jnp.maximum(room.used(times(room.turning, joints)), half_turns)


def displaced(coords: quat.Coordinates, room: Room, tangent: Array) -> Array:
    """A displacement u [nq] with q_m (+) u in its ranges, of a tangent [nv].

    A joint's rotation vector goes from r to r + Jr^-1(r) w, and no farther than to the
    sides of its box. To first order that is q_m exp(w), and no logarithm is needed to
    know where it ends. In a corner it may be longer than half a turn, as of
    `Room.turned`. u is exactly the identity where w is zero.

    Args:
        coords: of the character.
        room: of its q_m.
        tangent: the root's part in m, rad elsewhere.
    """
    scalars, turns, joints = _parts(coords, room, tangent)
    ends = jnp.clip(room.r + times(room.turning, joints), room.lower, room.upper)
    still = jnp.all(joints == 0.0, axis=-1, keepdims=True)
    moved = jnp.where(still, jnp.eye(4, dtype=ends.dtype)[0], room.turning_to(ends))
    return coords.join_q(scalars, jnp.concatenate([quat.exp(turns), moved]))


def clip(coords: quat.Coordinates, room: Room, u: Array) -> Array:
    """The displacement [nq] with q_m (+) u in its ranges; unchanged where it is."""
    scalars, quats = coords.split_q(u)
    turns, joints = quats[: -len(room.r)], quats[-len(room.r) :]
    r = room.turned(joints)
    inside = jnp.clip(r, room.lower, room.upper)
    outside = _square(inside - r) > 1e-12
    joints = jnp.where(outside, room.turning_to(inside), joints)
    return coords.join_q(scalars, jnp.concatenate([turns, joints]))


def softened(coords: quat.Coordinates, room: Room, u: Array) -> Array:
    """Whether a displacement [nq] uses more than `LINEAR_SHARE` of a joint's room."""
    joints = coords.split_q(u)[1][-len(room.r) :]
    return jnp.any(room.used(room.turned(joints) - room.r) > LINEAR_SHARE)


def inverse_right_jacobian(r: Array) -> Array:
    """Jr^-1(r) [J, 3, 3]: how fast log(q) changes from r when q turns with q' = q w.

    I + [r]x / 2 + c [r]x^2, c = 1 / a^2 - cot(a / 2) / (2 a), a = |r| below 2 pi.
    """
    a2 = _square(r)[:, :, None]
    small = a2 < 1e-4
    a = jnp.sqrt(jnp.where(small, 1.0, a2))
    c = jnp.where(small, 1.0 / 12.0, 1.0 / a**2 - 0.5 / (a * jnp.tan(0.5 * a)))
    eye = jnp.eye(3, dtype=r.dtype)
    cross = jnp.cross(r[:, None, :], eye).mT
    return eye + 0.5 * cross + c * (r[:, :, None] * r[:, None, :] - a2 * eye)


def _parts(
    coords: quat.Coordinates, room: Room, tangent: Array
) -> tuple[Array, Array, Array]:
    """Scalars [S], other turns [K - J, 3] and joints [J, 3] of a tangent [nv]."""
    scalars, tangents = coords.split_v(tangent)
    return scalars, tangents[: -len(room.r)], tangents[-len(room.r) :]


def _shortened(used: Array) -> Array:
    """The factor that takes a share of the room, 0 to infinity, to one below 1."""
    beyond = jnp.maximum(used - LINEAR_SHARE, 0.0) / (1.0 - LINEAR_SHARE)
    kept = LINEAR_SHARE + (1.0 - LINEAR_SHARE) * beyond / (1.0 + beyond)
    return jnp.where(beyond > 0.0, kept / jnp.where(beyond > 0.0, used, 1.0), 1.0)


def _square(v: Array) -> Array:
    return jnp.sum(v * v, axis=-1, keepdims=True)
