"""Unit quaternions, and the joint-wise displacement algebra of Sec. 3.4.

Quaternions are w, x, y, z. Every function takes leading batch axes. The tangent is
local, as in MuJoCo: `integrate(q, w) = q * exp(w)`, so a displacement composes on the
right: `oplus(q, u) = q * u` and `ominus(q, u) = q * u^-1`.
Departure: the paper prints log(u^-1 q) for q (-) u, which undoes a left
multiplication; with MuJoCo's local tangent, to which J refers, it has to be the right.

`Coordinates` is the static table that says which entries of `qpos` are quaternions; it
is all the joint-wise operations need to know of a model.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

Array = jax.Array


def mul(a: Array, b: Array) -> Array:
    """Hamilton product a * b, [..., 4] each."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def inv(q: Array) -> Array:
    """Inverse of a unit quaternion, [..., 4]."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def normalize(q: Array) -> Array:
    """q / |q|, [..., 4]."""
    return q * jax.lax.rsqrt(jnp.sum(q * q, axis=-1, keepdims=True))


def exp(w: Array) -> Array:
    """Quaternion of a rotation vector [..., 3] in rad; differentiable at zero."""
    angle2 = jnp.sum(w * w, axis=-1, keepdims=True)
    small = angle2 < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, angle2))
    half_sinc = jnp.where(small, 0.5 - angle2 / 48.0, jnp.sin(0.5 * angle) / angle)
    real = jnp.where(small, 1.0 - angle2 / 8.0, jnp.cos(0.5 * angle))
    return jnp.concatenate([real, half_sinc * w], axis=-1)


def log(q: Array) -> Array:
    """Rotation vector [..., 3] in rad of a unit quaternion, the short way round.

    q and -q give the same vector; its norm is at most pi. Differentiable at identity.
    """
    return long_log(jnp.where(q[..., :1] < 0.0, -q, q))


def long_log(q: Array) -> Array:
    """Rotation vector [..., 3] in rad of a unit quaternion, below a whole turn.

    -q turns about the same axis, the other way round, and `exp(long_log(q)) == q`, but
    for q = -1, whose axis is unknown: it gives zero.
    """
    real, imag = q[..., :1], q[..., 1:]
    norm2 = jnp.sum(imag * imag, axis=-1, keepdims=True)
    small = norm2 < 1e-8
    norm = jnp.sqrt(jnp.where(small, 1.0, norm2))
    safe_real = jnp.where(small, jnp.maximum(real, 0.5), 1.0)
    near = 2.0 / safe_real - 2.0 / 3.0 * norm2 / safe_real**3
    return jnp.where(small, near, _angle(norm, real) / norm) * imag


def _angle(sine: Array, cosine: Array) -> Array:
    """2 atan2(sine, cosine), rad, of a sine that is positive.

    XLA has no vector code for arctan2 on a CPU. Here the angle is halved twice, by
    tan(a/2) = sin a / (cos a + 1), for which the series of Cephes' `atanf` suffices.
    """
    if sine.dtype == jnp.float64:
        return 2.0 * jnp.arctan2(sine, cosine)
    x = sine / (jnp.abs(cosine) + jnp.sqrt(sine * sine + cosine * cosine))
    x = x / (1.0 + jnp.sqrt(1.0 + x * x))
    z = x * x
    series = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z
    angle = 8.0 * (x + x * z * (series - 3.33329491539e-1))
    return jnp.where(cosine < 0.0, 2.0 * jnp.pi - angle, angle)


def rotate(q: Array, v: Array) -> Array:
    """The vector v [..., 3] rotated by q [..., 4]."""
    real, imag = q[..., :1], q[..., 1:]
    cross = 2.0 * jnp.cross(imag, v)
    return v + real * cross + jnp.cross(imag, cross)


def to_matrix(q: Array) -> Array:
    """Rotation matrix [..., 3, 3] of q [..., 4]."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def slerp(a: Array, b: Array, t: Array) -> Array:
    """Point at t in [0, 1] on the short arc from a to b; t broadcasts to [..., 1]."""
    return mul(a, exp(t * log(mul(inv(a), b))))


def heading(q: Array) -> Array:
    """The rotation about +z that turns x forward as q does, [..., 4].

    The heading is the direction of q's x axis on the ground. Where that axis is
    vertical the heading is undefined and the identity is returned.
    """
    w, x, y, z = (q[..., i] for i in range(4))
    forward_x = 1.0 - 2.0 * (y * y + z * z)
    forward_y = 2.0 * (x * y + w * z)
    defined = forward_x**2 + forward_y**2 > 1e-10
    forward_x = jnp.where(defined, forward_x, 1.0)
    half = 0.5 * jnp.arctan2(jnp.where(defined, forward_y, 0.0), forward_x)
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Where quaternions and scalars lie in `qpos` and `qvel` of one model.

    A free joint is three scalars and a quaternion.
    """

    nq: int
    nv: int
    quat_qpos: np.ndarray  # [K, 4] indices of each quaternion in qpos
    quat_dof: np.ndarray  # [K, 3] indices of its tangent in qvel
    scalar_qpos: np.ndarray  # [S] indices of the remaining entries of qpos
    scalar_dof: np.ndarray  # [S] indices of their velocities

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Coordinates:
        """The table of a MuJoCo model."""
        quats, quat_dofs, scalars, scalar_dofs = [], [], [], []
        for kind, adr, dof in zip(
            model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True
        ):
            kind = mujoco.mjtJoint(kind)
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                scalars += range(adr, adr + 3)
                scalar_dofs += range(dof, dof + 3)
                adr, dof = adr + 3, dof + 3
            if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
                quats.append(range(adr, adr + 4))
                quat_dofs.append(range(dof, dof + 3))
            else:
                scalars.append(adr)
                scalar_dofs.append(dof)
        return cls(
            nq=model.nq,
            nv=model.nv,
            quat_qpos=np.array(quats, int).reshape(-1, 4),
            quat_dof=np.array(quat_dofs, int).reshape(-1, 3),
            scalar_qpos=np.array(scalars, int),
            scalar_dof=np.array(scalar_dofs, int),
        )

    def split_q(self, q: Array) -> tuple[Array, Array]:
        """Scalars [..., S] and quaternions [..., K, 4] of q [..., nq]."""
        return _entries(q, self.scalar_qpos), _entries(q, self.quat_qpos)

    def split_v(self, v: Array) -> tuple[Array, Array]:
        """Scalars [..., S] and tangents [..., K, 3] of v [..., nv]."""
        return _entries(v, self.scalar_dof), _entries(v, self.quat_dof)

    def join_q(self, scalars: Array, quats: Array) -> Array:
        """The inverse of `split_q`."""
        flat = jnp.concatenate(
            [scalars, quats.reshape(*quats.shape[:-2], self.quat_qpos.size)], axis=-1
        )
        order = np.concatenate([self.scalar_qpos, self.quat_qpos.ravel()])
        return _entries(flat, np.argsort(order))

    def join_v(self, scalars: Array, tangents: Array) -> Array:
        """The inverse of `split_v`."""
        flat = jnp.concatenate(
            [scalars, tangents.reshape(*tangents.shape[:-2], self.quat_dof.size)],
            axis=-1,
        )
        order = np.concatenate([self.scalar_dof, self.quat_dof.ravel()])
        return _entries(flat, np.argsort(order))


_MOST_SLICES = 8  # beyond them one gather is no slower


def _entries(x: Array, indices: np.ndarray) -> Array:
    """x[..., indices], as slices of what follows one another: XLA gathers slowly."""
    flat = indices.ravel()
    runs = np.split(flat, np.flatnonzero(np.diff(flat) != 1) + 1) if len(flat) else []
    parts = [x[..., run[0] : run[-1] + 1] for run in runs]
    if not 1 <= len(parts) <= _MOST_SLICES:
        return x[..., indices]
    part = parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)
    return part.reshape(*x.shape[:-1], *indices.shape)


def identity(coords: Coordinates) -> Array:
    """The displacement that changes nothing, [nq]."""
    u = np.zeros(coords.nq, np.float32)
    u[coords.quat_qpos[:, 0]] = 1.0
    return jnp.asarray(u)


def oplus(coords: Coordinates, q: Array, u: Array) -> Array:
    """q (+) u: quaternions composed on the right, scalars added (Sec. 3.4).

    Args:
        coords: the model's table.
        q: coordinates [..., nq].
        u: displacement in the same layout [..., nq].
    """
    q_scalars, q_quats = coords.split_q(q)
    u_scalars, u_quats = coords.split_q(u)
    return coords.join_q(q_scalars + u_scalars, mul(q_quats, u_quats))


def ominus(coords: Coordinates, q: Array, u: Array) -> Array:
    """q (-) u, the coordinates with `oplus(ominus(q, u), u) == q` (Sec. 4.2)."""
    q_scalars, q_quats = coords.split_q(q)
    u_scalars, u_quats = coords.split_q(u)
    return coords.join_q(q_scalars - u_scalars, mul(q_quats, inv(u_quats)))


def exp_map(coords: Coordinates, v: Array) -> Array:
    """Displacement [..., nq] of a tangent [..., nv]."""
    scalars, tangents = coords.split_v(v)
    return coords.join_q(scalars, exp(tangents))


def log_map(coords: Coordinates, u: Array) -> Array:
    """Tangent [..., nv] of a displacement [..., nq], the short way round."""
    scalars, quats = coords.split_q(u)
    return coords.join_v(scalars, log(quats))


def integrate(coords: Coordinates, q: Array, v: Array, dt: Array | float) -> Array:
    """q after moving with the velocity v [..., nv] for dt seconds, renormalized."""
    q_scalars, q_quats = coords.split_q(q)
    v_scalars, v_tangents = coords.split_v(v)
    quats = normalize(mul(q_quats, exp(dt * v_tangents)))
    return coords.join_q(q_scalars + dt * v_scalars, quats)
