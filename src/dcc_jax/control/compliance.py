"""The compliance-induced motion controller (Sec. 3.3 and 3.4, Alg. 1).

It turns external forces into a displacement u of the reference motion. Everything here
is written for ONE environment and knows no physics: Jacobians and accelerations come
in, a displacement comes out. Letters: F forces, nv velocities, nq coordinates.

The columns of J carry weights (Sec. 5.1), W = diag(w) >= 0. The displacement velocity
of one force is

    ud = alpha W J^T L xd,   L = (J W J^T + damping I)^-1.

It has the shape W J^T (...) of the paper's recipe, a joint of weight 2 turns twice as
far as it otherwise would, and J ud = alpha xd for any weights: the point of contact
yields by the share alpha.
Departure: scaling the columns everywhere, J' = J W, gives (J W^2 J^T)^-1 instead, hence
J ud = alpha J W J^T (J W^2 J^T)^-1 xd, which no longer is alpha xd, and Eq. (7) would
hold for equal weights alone.

What follows from J ud = alpha xd, with xd the measured velocity of the point: PD rests
where kp (q_m (+) u - q) + J^T f = 0, so x = J (q - q_m) = alpha x + J J^T f / kp, which
is Eq. (7), K_hat = kp (1 - alpha) L. It needs neither equal weights nor a square J, but
it does need: every joint driven by PD (a fixed base), displacements small enough for J
to be constant, directions in which J W J^T is well above the damping, and a velocity
that is measured. With the velocity of Alg. 1 u creeps for as long as the force acts and
there is no static stiffness at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat

Array = jax.Array
Velocity = Literal["forward_dynamics", "measured"]


@dataclass(frozen=True)
class ComplianceConfig:
    """Constants of the controller. The level alpha is not one: it may vary by episode.

    Raises:
        ValueError: an unknown `velocity`, or a number that is not positive and finite.
    """

    velocity: Velocity = "forward_dynamics"
    """Where xd comes from: Alg. 1, or Eq. (8) read literally."""
    response_time: float = 1.0 / 600.0
    """The h in xd = h J delta_qdd, s. The paper tuned alpha at 600 Hz (Sec. 5.1); it
    stays when the physics runs at another rate."""
    damping: float = 1e-4
    """Added to J W J^T, m^2: a lever arm of 1 cm yields half of what it should, one of
    10 cm 99 % of it."""
    joint_return_stiffness: float = 100.0
    """Of the spring-damper that takes u back, 1/s^2. Sec. 5.1 names the spring without
    a number; our choice, a time constant of 1 / sqrt(100) = 0.1 s."""
    root_return_stiffness: float = 60.0
    """The same for the root, 1/s^2, our choice: 0.13 s, a step back takes longer."""

    def __post_init__(self) -> None:
        if self.velocity not in get_args(Velocity):
            raise ValueError(
                f"velocity must be one of {get_args(Velocity)}, got {self.velocity!r}"
            )
        for name in (
            "response_time",
            "damping",
            "joint_return_stiffness",
            "root_return_stiffness",
        ):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")


@flax.struct.dataclass
class Displacement:
    """u and its velocity."""

    u: Array  # [nq], qpos layout: m on the root's translation, quaternions elsewhere
    ud: Array  # [nv], m/s and rad/s, local tangent


def at_rest(coords: quat.Coordinates) -> Displacement:
    """The displacement that changes nothing, u_0 of Alg. 1."""
    ud = jnp.zeros(coords.nv)
    return Displacement(u=quat.identity(coords).astype(ud.dtype), ud=ud)


def return_stiffness(config: ComplianceConfig, nv: int, root_dofs: int = 6) -> Array:
    """Spring constants [nv] of the return, 1/s^2; the first `root_dofs` are the root's.

    Raises:
        ValueError: `root_dofs` outside [0, nv].
    """
    if not 0 <= root_dofs <= nv:
        raise ValueError(f"root_dofs must be in [0, {nv}], got {root_dofs}")
    stiffness = np.full(nv, config.joint_return_stiffness)
    stiffness[:root_dofs] = config.root_return_stiffness
    return jnp.asarray(stiffness, jnp.zeros(0).dtype)


def acting(forces: Array) -> Array:
    """Whether any of the forces [..., 3] differs from exactly zero, a boolean."""
    return jnp.any(forces != 0.0)


def point_velocity(J: Array, qvel: Array, weights: Array) -> Array:
    """Velocity [F, 3] of the points, m/s, through the columns that may be displaced.

    Args:
        J: Jacobians of the points [F, 3, nv], world frame.
        qvel: velocities [nv] or [F, nv]. For the measured estimator: those of the
            character less those of the reference.
        weights: of the columns [nv]; a column of weight zero carries no motion. Else
            what the root does, which u may not follow, were to come from the joints.
    """
    qvel = jnp.where(weights > 0.0, qvel, 0.0)
    return jnp.sum(J * qvel[..., None, :], axis=-1)


def displacement_velocity(
    J: Array, motion: Array, alpha: Array, weights: Array, config: ComplianceConfig
) -> Array:
    """The velocity ud [nv] of the displacement, Eq. (8), summed over F forces.

    With `velocity="forward_dynamics"` no force moves u faster than
    alpha * response_time * |delta_qdd|, as in the paper, where J^T L J is an orthogonal
    projector. Unequal weights make it an oblique one, which alone would allow
    sqrt(w_max / w_min) times that; such a velocity is shortened to the bound.

    Args:
        J: Jacobians of the points where the forces act [F, 3, nv], world frame.
        motion: by `config.velocity`; delta_qdd = M^-1 J^T f, the change of the joint
            accelerations [F, nv], or the velocity of the points relative to the
            reference, m/s [F, 3], see `point_velocity`.
        alpha: level of compliance, in [0, 1] (unchecked: it is traced).
        weights: of J's columns [nv], not negative.
        config: the constants.
    """
    count, _, nv = J.shape
    measured = config.velocity == "measured"
    chex.assert_shape(motion, (count, 3) if measured else (count, nv))
    WJ = J * weights
    JWJ = jnp.sum(WJ[:, :, None, :] * J[:, None, :, :], axis=-1)
    xd = (
        motion
        if measured
        else config.response_time * point_velocity(J, motion, weights)
    )
    ud = jnp.sum(WJ * _solve_damped(JWJ, xd, config.damping)[..., None], axis=1)
    if not measured:
        ud = _shorten(ud, config.response_time * _norm(motion))
    return alpha * jnp.sum(ud, axis=0)


def advance(
    coords: quat.Coordinates,
    displacement: Displacement,
    ud_forces: Array,
    active: Array,
    dt: float,
    return_stiffness: Array,
) -> Displacement:
    """The displacement one physics step later: u (+) dt ud.

    While a force acts, ud is what the forces ask for. When none does, (u, ud) is a
    critically damped spring-damper of unit mass back to zero, integrated by implicit
    Euler, stable for any dt. ud carries over from the one to the other.

    Args:
        coords: the layout of u.
        displacement: before the step.
        ud_forces: from `displacement_velocity` [nv].
        active: whether any force acts, a boolean; see `acting`.
        dt: physics step, s.
        return_stiffness: [nv], 1/s^2.
    """
    k = return_stiffness
    offset = quat.log_map(coords, displacement.u)
    ud_return = (displacement.ud - dt * k * offset) / (1.0 + dt * jnp.sqrt(k)) ** 2
    ud = jnp.where(active, ud_forces, ud_return)
    return Displacement(u=quat.integrate(coords, displacement.u, ud, dt), ud=ud)


def _norm(v: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(v), axis=-1))


def _shorten(v: Array, bound: Array) -> Array:
    """v [..., n] scaled down to the norm `bound` where it is longer."""
    norm = _norm(v)
    longer = norm > bound
    return v * jnp.where(longer, bound / jnp.where(longer, norm, 1.0), 1.0)[..., None]


def _solve_damped(A: Array, b: Array, damping: float) -> Array:
    """(A + damping I)^-1 b for positive semidefinite A [..., 3, 3], b [..., 3].

    A = U^T D U written out: `jnp.linalg` costs one LAPACK call an environment, and the
    adjugate loses all digits in float32 where two directions are singular.
    """
    d0 = A[..., 0, 0] + damping
    u01, u02 = A[..., 0, 1] / d0, A[..., 0, 2] / d0
    d1 = A[..., 1, 1] + damping - A[..., 0, 1] * u01
    d1 = jnp.maximum(d1, damping)
    u12 = (A[..., 1, 2] - A[..., 0, 1] * u02) / d1
    d2 = A[..., 2, 2] + damping - A[..., 0, 2] * u02 - d1 * u12 * u12
    d2 = jnp.maximum(d2, damping)
    y0 = b[..., 0]
    y1 = b[..., 1] - u01 * y0
    y2 = b[..., 2] - u02 * y0 - u12 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - u12 * x2
    x0 = y0 / d0 - u01 * x1 - u02 * x2
    return jnp.stack([x0, x1, x2], axis=-1)
