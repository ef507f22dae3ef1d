"""What a pose and its velocity say of the character: energy, soles, joint ranges.

Everything comes from our own kinematics, for ONE environment. `q` and `qd` are the
character's own coordinates [55] and velocities [42].
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import quat
from dcc_jax.character import (
    CONTROL_DT,
    FEET,
    GRAVITY,
    Character,
    compose_scene,
    sole_names,
)
from dcc_jax.env import features
from dcc_jax.env.features import Kinematics

Array = jax.Array

TOUCH = 0.005  # m, a sole's sphere closer than this to the ground stands on it


@dataclass(frozen=True, eq=False)
class Mechanics:
    """Masses, inertias, soles and joint ranges of one character."""

    kinematics: Kinematics
    mass: np.ndarray  # [15] kg
    center: np.ndarray  # [15, 3] m, centre of mass in the body's frame
    inertia: np.ndarray  # [15, 3, 3] kg m^2 about it, in the body's frame
    sole_body: np.ndarray  # [8] body of each sole sphere
    sole_center: np.ndarray  # [8, 3] m, in its body's frame
    sole_radius: float  # m
    lower: np.ndarray  # [12, 3] rad, of the joints' rotation vectors
    upper: np.ndarray  # [12, 3]

    @classmethod
    def of(cls, character: Character) -> Mechanics:
        """The tables of a mass variant."""
        model = compose_scene(character, floor=False)
        turn = np.zeros((model.nbody, 9))
        for matrix, iquat in zip(turn, model.body_iquat, strict=True):
            mujoco.mju_quat2Mat(matrix, iquat)
        turn = turn.reshape(-1, 3, 3)
        inertia = turn * model.body_inertia[:, None, :] @ turn.transpose(0, 2, 1)
        soles = [model.geom(name).id for name in sole_names(character.spec())]
        return cls(
            kinematics=Kinematics.of(model),
            mass=model.body_mass[1:],
            center=model.body_ipos[1:],
            inertia=inertia[1:],
            sole_body=model.geom_bodyid[soles] - 1,
            sole_center=model.geom_pos[soles],
            sole_radius=float(model.geom_size[soles[0], 0]),
            lower=character.lower,
            upper=character.upper,
        )


def energy(mechanics: Mechanics, q: Array, qd: Array) -> tuple[Array, Array]:
    """Kinetic and potential energy [] of the character, J; the latter zero at z = 0."""

    def centers(time: Array) -> tuple[Array, Array]:
        moved = quat.integrate(mechanics.kinematics.coords, q, qd, time)
        pos_w, quat_w = features.body_poses(mechanics.kinematics, moved)
        return pos_w + quat.rotate(quat_w, jnp.asarray(mechanics.center)), quat_w

    zero = jnp.zeros(())
    (center_w, quat_w), (velocity, rate) = jax.jvp(centers, (zero,), (jnp.ones(()),))
    spin = 2.0 * quat.mul(quat.inv(quat_w), rate)[:, 1:]  # rad/s, in the body's frame
    moment = jnp.einsum("bij,bj->bi", jnp.asarray(mechanics.inertia), spin)
    mass = jnp.asarray(mechanics.mass)
    linear = jnp.sum(mass * jnp.sum(velocity**2, axis=-1))
    kinetic = 0.5 * (linear + jnp.sum(spin * moment))
    return kinetic, GRAVITY * jnp.sum(mass * center_w[:, 2])


def sole_points(mechanics: Mechanics, q: Array) -> Array:
    """The lowest points [8, 3] of the sole spheres, world, m."""
    pos_w, quat_w = features.body_poses(mechanics.kinematics, q)
    body = mechanics.sole_body
    center_w = pos_w[body] + quat.rotate(
        quat_w[body], jnp.asarray(mechanics.sole_center)
    )
    return center_w - jnp.array([0.0, 0.0, mechanics.sole_radius])


def slip(
    points: Array, before: Array, ground: Array, ground_before: Array
) -> tuple[Array, Array]:
    """How far soles that stood before and now slid over the ground meanwhile.

    Args:
        points: of `sole_points` now [8, 3].
        before: a moment ago.
        ground: height of the ground now [], m.
        ground_before: and then.

    Returns:
        the mean distance [] in m over the spheres that stand, and whether any does [].
    """
    stands = (points[:, 2] < ground + TOUCH) & (before[:, 2] < ground_before + TOUCH)
    moved = points[:, :2] - before[:, :2]
    distance = jnp.sqrt(jnp.sum(moved**2, axis=-1) + 1e-12)
    count = jnp.sum(stands)
    return jnp.sum(stands * distance) / jnp.maximum(count, 1), count > 0


def sliding(mechanics: Mechanics, q: Array, q_previous: Array) -> Array:
    """How fast what stands of each foot slides over the ground, [2] m/s.

    The mean over the spheres of a foot, of which each counts by how near to the ground
    it is at both moments: all of it on the ground and below, 14 % `TOUCH` above. What
    the discriminator sees has to be smooth; `slip` is the measure of an evaluation.

    Args:
        mechanics: of the character.
        q: now [55], its height above the ground.
        q_previous: the same, one control step ago.
    """
    now, before = sole_points(mechanics, q), sole_points(mechanics, q_previous)
    height = jnp.maximum(jnp.stack([now[:, 2], before[:, 2]]), 0.0)
    stands = jnp.exp(-jnp.sum((height / TOUCH) ** 2, axis=0))
    moved = now[:, :2] - before[:, :2]
    distance = jnp.sqrt(jnp.sum(moved**2, axis=-1) + 1e-12)
    return jnp.mean((stands * distance).reshape(len(FEET), -1), axis=1) / CONTROL_DT


def range_excess(mechanics: Mechanics, q: Array) -> Array:
    """How far [12, 3] the joints' rotation vectors lie outside their ranges, rad."""
    vectors = quat.log_map(mechanics.kinematics.coords, q)[6:].reshape(-1, 3)
    above = jnp.maximum(vectors - mechanics.upper, 0.0)
    return above + jnp.maximum(mechanics.lower - vectors, 0.0)
