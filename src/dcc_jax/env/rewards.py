"""The reward of Sec. 4.1: Eq. (10), Eq. (11), Eq. (13) and Eq. (14).

Arrays in, arrays out, any batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

Array = jax.Array


@dataclass(frozen=True)
class RewardConfig:
    """Weights and widths.

    Raises:
        ValueError: a number that is negative or not finite.
    """

    w_imit: float = 0.5
    """Weight of the imitation where the task has a reward of its own, Eq. (10)."""
    w_task: float = 0.5
    """Weight of that task reward, Eq. (10)."""
    beta: float = 0.2
    """Shape of r_q, Eq. (13): 0.2 for small data sets, 0.25 for large ones."""
    w_p: float = 0.7
    """Weight of the root's position in r_p, Eq. (14)."""
    w_v: float = 0.3
    """Weight of the root's velocity in r_p, Eq. (14)."""
    sigma_p: float = 0.5
    """Sharpness in position, 1/m^2, Eq. (14)."""
    sigma_v: float = 1.0
    """Sharpness in velocity, s^2/m^2, Eq. (14)."""
    sigma_q: float = 2.0
    """Sharpness of the tracking reward, 1/rad^2 (Peng et al. 2018)."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {value}")


def pose_reward(d: Array, config: RewardConfig) -> Array:
    """r_q = 1 - beta (D(s, s') - 1)^2, Eq. (13), floored at 0.

    Departure: the floor, as in AMP (Peng et al. 2021), whose reward this is with beta =
    0.25. Without it a confident discriminator makes r_q r_p negative, and the character
    is then rewarded for leaving its reference's position.

    Args:
        d: output of the discriminator [...]; 1 is the expert's value.
        config: beta.
    """
    return jnp.maximum(0.0, 1.0 - config.beta * jnp.square(d - 1.0))


def tracking_reward(error: Array, config: RewardConfig) -> Array:
    """r_q = exp(-sigma_q sum |log(q_m^-1 q)|^2), the pose term of Peng et al. 2018.

    It takes the place of `pose_reward` where q_m(t) is known, as in the Appendix.

    Args:
        error: rotation vectors from the reference to the pose [..., J, 3], rad.
        config: its sharpness.
    """
    return jnp.exp(-config.sigma_q * jnp.sum(jnp.square(error), axis=(-2, -1)))


def position_reward(
    p: Array, v: Array, u_p: Array, ud_p: Array, config: RewardConfig
) -> Array:
    """r_p = w_p exp(-sigma_p |p - u_p|^2) + w_v exp(-sigma_v |v - ud_p|^2), Eq. (14).

    Args:
        p: position of the root relative to the reference's root [..., 3], world, m.
        v: its velocity relative to the reference's [..., 3], world, m/s.
        u_p: root part of the displacement [..., 3], m.
        ud_p: its velocity [..., 3], m/s.
        config: weights and widths.
    """
    off_position = jnp.sum(jnp.square(p - u_p), axis=-1)
    off_velocity = jnp.sum(jnp.square(v - ud_p), axis=-1)
    return config.w_p * jnp.exp(-config.sigma_p * off_position) + config.w_v * jnp.exp(
        -config.sigma_v * off_velocity
    )


def reward(
    r_q: Array, r_p: Array, config: RewardConfig, r_task: Array | None = None
) -> Array:
    """r = w_imit r_q r_p + w_task r_task, Eq. (10) and (11).

    Args:
        r_q: pose reward [...].
        r_p: positional reward [...].
        config: the weights.
        r_task: the task's reward [...], or None where the task has none; then r is
            r_q r_p alone, unweighted, so that rewards of all tasks end at 1.
    """
    r_imit = r_q * r_p
    if r_task is None:
        return r_imit
    return config.w_imit * r_imit + config.w_task * r_task
