"""The compliance-induced motion controller (Sec. 3.3 and 3.4, Alg. 1).

It turns external forces into a displacement u of the reference motion. Everything here
is written for ONE environment and knows no physics: Jacobians, forces and a solver of
the mass matrix come in, a displacement comes out. Letters: F forces, nv velocities, nq
coordinates.

The columns of J carry weights (Sec. 5.1), W = diag(w) >= 0. The displacement velocity
of one force is

    ud = alpha W J^T L xd,   L = (J W J^T + damping I)^-1.

It has the shape W J^T (...) of the paper's recipe, a joint of weight 2 turns twice as
far as it otherwise would, and J ud = alpha xd for any positive weights: the point of
contact yields by the share alpha.
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
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
    """Where xd comes from: Alg. 1, or Eq. (8) read literally, which needs a task that
    follows its reference in time."""
    response_time: float = 1.0 / 600.0
    """The h in xd = h J delta_qdd, s. The paper tuned alpha at 600 Hz (Sec. 5.1); it
    stays when the physics runs at another rate."""
    damping: float = 1e-4
    """Added to J W J^T, m^2: J W J^T L of a lever arm of 1 cm is 1/2, of one of 10 cm
    0.99. Alg. 1 yields by its square, Eq. (8) with measured velocities by itself."""
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


@dataclass(frozen=True, eq=False)
class Controller:
    """What stays the same from step to step.

    Raises:
        ValueError: `root_dofs` outside [0, nv].
    """

    config: ComplianceConfig
    coords: quat.Coordinates  # the layout of u
    weights: np.ndarray | Array  # [nv] of J's columns, not negative
    dt: float  # physics step, s
    root_dofs: int = 6  # how many of the first columns are the root's

    def __post_init__(self) -> None:
        if not 0 <= self.root_dofs <= self.coords.nv:
            raise ValueError(
                f"root_dofs must be in [0, {self.coords.nv}], got {self.root_dofs}"
            )

    @property
    def return_stiffness(self) -> np.ndarray:
        """Spring constants [nv] of the return, 1/s^2."""
        stiffness = np.full(self.coords.nv, self.config.joint_return_stiffness)
        stiffness[: self.root_dofs] = self.config.root_return_stiffness
        return stiffness


def algorithm_1(
    controller: Controller,
    displacement: Displacement,
    J: Array,
    forces: Array,
    alpha: Array,
    mass_solve: Callable[[Array], Array],
) -> Displacement:
    """The displacement one physics step later, by Alg. 1.

    While forces act, each adds ud = alpha W J^T L xd with xd = h J delta_qdd. Without
    any, a spring-damper takes u back (Sec. 5.1).

    Departure: delta_qdd is that of S f, with S = J W J^T L. S is 1 in directions that u
    can displace the point in, and 0 in the others: a column of weight zero takes some
    away. The point yields by J ud = alpha S xd. With the whole f, its part along a
    direction that u cannot follow would displace the point in the others, and even
    against the force. With S f

        f . (J ud) = alpha h (S f) . J M^-1 J^T (S f) >= 0

    for any weights and damping. xd needs no mask for that, and has none in the paper.

    No force moves u faster than alpha h |delta_qdd|, as in the paper, where J^T L J is
    an orthogonal projector. Weights make it an oblique one, which alone may give more;
    such a velocity is shortened to the bound.

    Args:
        controller: of the character.
        displacement: before the step.
        J: Jacobians of the points where the forces act [F, 3, nv], world frame.
        forces: N, world frame [F, 3]; exactly zero where none acts.
        alpha: level of compliance, in [0, 1] (unchecked: it is traced).
        mass_solve: M^-1 times generalized forces [F, nv]. Forward dynamics is linear in
            the external force: M^-1 J^T f is FD(q, qd, f) - FD(q, qd, 0).
    """
    h = controller.config.response_time
    W, JWJ, L = _laplacian(controller, J)
    f = _times(JWJ, L(forces))
    delta_qdd = mass_solve(_transpose_times(J, f))
    xd = h * _times(J, delta_qdd)
    ud = W * _transpose_times(J, L(xd))
    ud = _shorten(ud, h * _norm(delta_qdd))
    ud = alpha * jnp.sum(ud, axis=0)
    return advance(controller, displacement, ud, acting(forces))


def measured(
    controller: Controller,
    displacement: Displacement,
    J: Array,
    forces: Array,
    alpha: Array,
    xd: Array,
) -> Displacement:
    """The displacement one physics step later, by Eq. (8) with measured velocities.

    Args:
        controller: of the character.
        displacement: before the step.
        J: Jacobians of the points where the forces act [F, 3, nv], world frame.
        forces: N, world frame [F, 3]; exactly zero where none acts.
        alpha: level of compliance, in [0, 1] (unchecked: it is traced).
        xd: velocities of the points less those of the same points of the reference,
            displaced by a u at rest, m/s [F, 3].
    """
    W, _, L = _laplacian(controller, J)
    xd = jnp.any(forces != 0.0, axis=-1, keepdims=True) * xd
    ud = alpha * jnp.sum(W * _transpose_times(J, L(xd)), axis=0)
    return advance(controller, displacement, ud, acting(forces))


def acting(forces: Array) -> Array:
    """Whether any of the forces [..., 3] differs from exactly zero, a boolean."""
    return jnp.any(forces != 0.0)


def advance(
    controller: Controller, displacement: Displacement, ud: Array, active: Array
) -> Displacement:
    """The displacement one physics step later: u (+) dt ud.

    While a force acts, ud is what the forces ask for. When none does, (u, ud) is a
    critically damped spring-damper of unit mass back to zero, integrated by implicit
    Euler, stable for any dt. ud carries over from the one to the other.

    Args:
        controller: of the character.
        displacement: before the step.
        ud: velocity that the forces ask for [nv].
        active: whether any force acts, a boolean; see `acting`.
    """
    coords, dt = controller.coords, controller.dt
    k = jnp.asarray(controller.return_stiffness, ud.dtype)
    offset = quat.log_map(coords, displacement.u)
    ud_return = (displacement.ud - dt * k * offset) / (1.0 + dt * jnp.sqrt(k)) ** 2
    ud = jnp.where(active, ud, ud_return)
    return Displacement(u=quat.integrate(coords, displacement.u, ud, dt), ud=ud)


def _laplacian(
    controller: Controller, J: Array
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Diagonal of W [nv], J W J^T [F, 3, 3], and L, a function of vectors [F, 3]."""
    chex.assert_shape(J, (None, 3, controller.coords.nv))
    W = jnp.asarray(controller.weights, J.dtype)
    JWJ = jnp.sum((J * W)[:, :, None, :] * J[:, None, :, :], axis=-1)
    return W, JWJ, partial(_solve_damped, JWJ, controller.config.damping)


def _times(A: Array, v: Array) -> Array:
    """A v [F, m] of A [F, m, n] and v [F, n]."""
    return jnp.sum(A * v[:, None, :], axis=-1)


def _transpose_times(J: Array, x: Array) -> Array:
    """J^T x [F, nv] of J [F, 3, nv] and x [F, 3]."""
    return jnp.sum(J * x[:, :, None], axis=1)


def _norm(v: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(v), axis=-1))


def _shorten(v: Array, bound: Array) -> Array:
    """v [..., n] scaled down to the norm `bound` where it is longer."""
    norm = _norm(v)
    longer = norm > bound
    return v * jnp.where(longer, bound / jnp.where(longer, norm, 1.0), 1.0)[..., None]


def _solve_damped(A: Array, damping: float, b: Array) -> Array:
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
