"""The compliance-induced motion controller (Sec. 3.3 and 3.4): three laws.

External forces displace the reference motion by u; PD follows q_m (+) u. Eq. (6) asks
for dq_bar/dx = alpha J^T L, L = (J J^T)^-1, and gets Eq. (7), K_hat = kp (1 - alpha) L.

    algorithm_1   u' = alpha W J^T L h J M^-1 J^T f      Alg. 1
    measured      u' = alpha W J^T L (xd - xd of q_m)    Eq. (8)
    admittance    u = alpha y, y -> J^T f / (kp (1 - alpha))   Eq. (6) and (7)

Alg. 1 follows the impulse of a force. While a force lasts u creeps, so that there is no
static stiffness. With measured velocities u rests when the character does; Eq. (7) then
holds for any weights, as long as every joint is driven by PD. Admittance knows the
yield y of the joints that Eq. (7) has at rest, takes the share alpha of it that Eq. (6)
gives to the reference, and leaves the rest to PD, whatever the motion.

The columns of J carry weights (Sec. 5.1), W = diag(w) >= 0. In the first two laws
L = (J W J^T + damping I)^-1, so that J u' = alpha xd for any positive weights: the
point yields by the share alpha. In the third a joint of weight w has the stiffness
kp / (1 + w alpha / (1 - alpha)), which is kp (1 - alpha) at weight 1.
Departure: scaling the columns everywhere, J' = J W, gives (J W^2 J^T)^-1 instead, and
Eq. (7) would hold for equal weights alone.

Everything here is written for ONE environment and knows no physics. Letters: F forces,
nv velocities, nq coordinates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import chex
import jax
import jax.numpy as jnp

from dcc_jax import quat
from dcc_jax.control import admittance_kernel, ranges
from dcc_jax.control.controller import Controller, Displacement, at_rest
from dcc_jax.control.ranges import Room
from dcc_jax.control.small_matrix import (
    norm,
    shorten,
    solve_damped,
    times,
    transpose_times,
)

__all__ = [
    "Controller",
    "Displacement",
    "acting",
    "admittance",
    "advance",
    "algorithm_1",
    "at_rest",
    "greatest_alpha",
    "measured",
    "whole_yield",
    "yield_at_rest",
]

Array = jax.Array


def algorithm_1(
    controller: Controller,
    displacement: Displacement,
    J: Array,
    forces: Array,
    alpha: Array,
    room: Room | None,
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
        room: of the reference, that u stays in; see `Controller.room`.
        mass_solve: M^-1 times generalized forces [F, nv]. Forward dynamics is linear in
            the external force: M^-1 J^T f is FD(q, qd, f) - FD(q, qd, 0).
    """
    h = controller.config.response_time
    W, JWJ, L = _laplacian(controller, J)
    f = times(JWJ, L(forces))
    delta_qdd = mass_solve(transpose_times(J, f))
    xd = h * times(J, delta_qdd)
    ud = W * transpose_times(J, L(xd))
    ud = shorten(ud, h * norm(delta_qdd))
    ud = alpha * jnp.sum(ud, axis=0)
    return advance(controller, displacement, ud, acting(forces), room)


def measured(
    controller: Controller,
    displacement: Displacement,
    J: Array,
    forces: Array,
    alpha: Array,
    room: Room | None,
    xd: Array,
) -> Displacement:
    """The displacement one physics step later, by Eq. (8) with measured velocities.

    Args:
        controller: of the character.
        displacement: before the step.
        J: Jacobians of the points where the forces act [F, 3, nv], world frame.
        forces: N, world frame [F, 3]; exactly zero where none acts.
        alpha: level of compliance, in [0, 1] (unchecked: it is traced).
        room: of the reference, that u stays in; see `Controller.room`.
        xd: velocities of the points less those of the same points of the reference,
            displaced by a u at rest, m/s [F, 3].
    """
    W, _, L = _laplacian(controller, J)
    xd = jnp.any(forces != 0.0, axis=-1, keepdims=True) * xd
    ud = alpha * jnp.sum(W * transpose_times(J, L(xd)), axis=0)
    return advance(controller, displacement, ud, acting(forces), room)


def admittance(
    controller: Controller,
    displacement: Displacement,
    torque: Array,
    alpha: Array,
    room: Room | None,
) -> Displacement:
    """The displacement one physics step later, on its way to where Eq. (7) has it.

    At rest the point yields by x = K_hat^-1 f, the joints by y = J^T L x, and Eq. (6)
    displaces the reference by u = alpha y. For weights W, joint by joint,

        y* = (1 + W alpha / (1 - alpha)) J^T f / kp,   y'' = w^2 (y* - y) - 2 w y',
        u = W alpha / (1 - alpha + W alpha) y,

    with w^2 the return stiffness. Without a force this is the return of Sec. 5.1.
    f . (J y*) >= 0, whatever the weights and the room.

    Args:
        controller: of the character.
        displacement: before the step.
        torque: J^T f, summed over the forces [nv]; exactly zero where none acts.
        alpha: level of compliance, in [0, 1) (unchecked: it is traced).
        room: of the reference, that its yield stays in; see `Controller.room`.
    """
    coords, dt = controller.coords, controller.dt
    chex.assert_shape(torque, (coords.nv,))
    if room is not None and admittance_kernel.serves(controller, torque):
        given = displacement, torque, jnp.asarray(alpha), room
        return admittance_kernel.admittance(controller, *given)
    rest = yield_at_rest(controller, torque, alpha, room)
    _, share = _softening(controller, alpha, torque.dtype)
    yd = _sprung(controller, displacement.y - rest, displacement.yd)
    y = displacement.y + dt * yd
    if room is None:
        u = quat.exp_map(coords, share * y)
    else:
        u = ranges.displaced(coords, room, share * y)
    return Displacement(u=u, ud=share * yd, y=y, yd=yd)


def yield_at_rest(
    controller: Controller, torque: Array, alpha: Array, room: Room | None
) -> Array:
    """y* [nv], m and rad, of `admittance` under generalized forces `torque` [nv].

    Args:
        controller: of the character.
        torque: J^T f, summed over the forces.
        alpha: level of compliance, in [0, 1) (unchecked: it is traced).
        room: of the reference, that the yield stays in.
    """
    softer, _ = _softening(controller, alpha, torque.dtype)
    rest = softer * torque / jnp.asarray(controller.kp, torque.dtype)
    return rest if room is None else ranges.bounded(controller.coords, room, rest)


def greatest_alpha(
    controller: Controller, q_m: Array, J: Array, forces: Array
) -> Array:
    """The level [] up to which the joints yield to constant forces in full.

    That is of `admittance`. Beyond it some joint would use more than
    `ranges.LINEAR_SHARE` of its room, and its yield is shortened. 0 where PD alone
    does.

    Args:
        controller: of the character, with joint ranges.
        q_m: the reference [nq].
        J: Jacobians of the points where the forces act [F, 3, nv], world frame.
        forces: N, world frame [F, 3].
    """
    room = controller.room(q_m)
    assert room is not None
    torque = jnp.sum(transpose_times(J, forces), axis=0)
    alone = torque / jnp.asarray(controller.kp, J.dtype)
    # A joint that yields n times as far as by PD alone has 1 + W alpha / (1 - alpha)
    # = n.
    farther = ranges.LINEAR_SHARE / ranges.used(controller.coords, room, alone)
    W = jnp.asarray(controller.weights, J.dtype)[controller.coords.quat_dof[1:, 0]]
    odds = jnp.min(jnp.where(W > 0.0, jnp.maximum(farther - 1.0, 0.0) / W, jnp.inf))
    return jnp.minimum(1.0 - 1.0 / (1.0 + odds), controller.config.greatest_alpha)


def _softening(
    controller: Controller, alpha: Array, dtype: jnp.dtype
) -> tuple[Array, Array]:
    """How much farther than PD alone a joint yields [nv], and u's share of it [nv].

    PD does not drive the root: all that it yields is u.
    """
    W = jnp.asarray(controller.weights, dtype)
    by_u = W * alpha / (1.0 - alpha)
    softer = by_u + controller.driven
    return softer, by_u / jnp.where(softer > 0.0, softer, 1.0)


def whole_yield(controller: Controller, displacement: Displacement) -> Array:
    """Where forces have the pose, relative to the reference: q_m (+) this, [nq].

    With `admittance` the yield of Eq. (7), of which u is a part and PD gives way by the
    rest; to first order, since no joint range bounds what PD gives way by. The other
    laws do not know what PD does, and it is u.
    """
    if controller.config.law == "admittance":
        return quat.exp_map(controller.coords, displacement.y)
    return displacement.u


def acting(forces: Array) -> Array:
    """Whether any of the forces [..., 3] differs from exactly zero, a boolean."""
    return jnp.any(forces != 0.0)


def advance(
    controller: Controller,
    displacement: Displacement,
    ud: Array,
    active: Array,
    room: Room | None = None,
) -> Displacement:
    """The displacement one physics step later: u (+) dt ud.

    While a force acts, ud is what the forces ask for. When none does, a spring-damper
    takes u back to zero. ud carries over from the one to the other.

    Args:
        controller: of the character.
        displacement: before the step.
        ud: velocity that the forces ask for [nv].
        active: whether any force acts, a boolean; see `acting`.
        room: of the reference, that u stays in.
    """
    offset = quat.log_map(controller.coords, displacement.u)
    ud = jnp.where(active, ud, _sprung(controller, offset, displacement.ud))
    u = quat.integrate(controller.coords, displacement.u, ud, controller.dt)
    if room is not None:
        u = ranges.clip(controller.coords, room, u)
    return dataclasses.replace(displacement, u=u, ud=ud)


def _sprung(controller: Controller, offset: Array, speed: Array) -> Array:
    """Velocity [nv] a step later of a critically damped spring-damper of unit mass.

    It is `offset` [nv] away from its rest. Implicit Euler, stable for any dt.
    """
    dt = controller.dt
    k = jnp.asarray(controller.return_stiffness, offset.dtype)
    return (speed - dt * k * offset) / (1.0 + dt * jnp.sqrt(k)) ** 2


def _laplacian(
    controller: Controller, J: Array
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Diagonal of W [nv], J W J^T [F, 3, 3], and L, a function of vectors [F, 3]."""
    chex.assert_shape(J, (None, 3, controller.coords.nv))
    W = jnp.asarray(controller.weights, J.dtype)
    JWJ = jnp.sum((J * W)[:, :, None, :] * J[:, None, :, :], axis=-1)
    return W, JWJ, partial(solve_damped, JWJ, controller.config.damping)
