"""Stable PD control (Eq. (2), Tan et al. 2011).

Stable PD evaluates Eq. (2) at the end of the step:

    (M + h Kv) qdd = Kp (q_bar - q - h qd) - Kv qd + rest.

With scalar gains per ball joint the left side is the mass matrix with h*kv on its
diagonal, which `physics.make_scene` puts there once; the right side is `torque` below.
One factorization a step serves the dynamics and the controller.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dcc_jax import quat
from dcc_jax.character import Character

Array = jax.Array


def torque(character: Character, q: Array, qd: Array, q_bar: Array, h: float) -> Array:
    """Explicit part of the stable PD torques [42], N m, zero on the root, Eq. (2).

    Departure: the torque limit (the paper states none) clips this explicit part.

    Args:
        character: gains and limits.
        q: the character's coordinates [55].
        qd: its velocities [42].
        q_bar: target coordinates [55]; the root part is ignored.
        h: physics step in s.
    """
    return clipped(character, unclipped(character, q, qd, q_bar, h))


def unclipped(
    character: Character, q: Array, qd: Array, q_bar: Array, h: float
) -> Array:
    """kp (log(q^-1 q_bar) - h qd) - kv qd, the error the short way round, [42]."""
    joints, targets = q[7:].reshape(-1, 4), q_bar[7:].reshape(-1, 4)
    error = quat.log(quat.mul(quat.inv(joints), targets)).reshape(-1)
    error = jnp.concatenate([jnp.zeros(6, error.dtype), error])
    kp = jnp.asarray(character.kp, error.dtype)
    kv = jnp.asarray(character.kv, error.dtype)
    return kp * (error - h * qd) - kv * qd


def clipped(character: Character, tau: Array) -> Array:
    """tau within the torque limits, [42]."""
    limit = jnp.asarray(character.torque_limit, tau.dtype)
    return jnp.clip(tau, -limit, limit)
