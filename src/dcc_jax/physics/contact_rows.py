"""Contacts as what their four constraint rows are made of, without Jacobians.

The rows of a contact are the edges of MuJoCo's friction pyramid, normal +- mu tangent.
All four have the same regularization, damping and stiffness. Letters: C contacts.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import mujoco

from dcc_jax.physics.quiet_mjx import mjx

Array = jax.Array


@flax.struct.dataclass
class ContactRows:
    """Of every contact slot; aref of a row is `aref` - `damping` J qvel."""

    frame_w: Array  # [C, 3, 3] normal and two tangents; zero where the geoms are apart
    point_w: Array  # [C, 3] m
    friction: Array  # [C, 2] along the tangents
    D: Array  # [C] inverse of the rows' regularization
    aref: Array  # [C] reference acceleration of penetration alone
    damping: Array  # [C] 1/s


def contact_rows(model: mjx.Model, data: mjx.Data) -> ContactRows:
    """Of a state with its contacts, as `mjx.make_constraint` has them (condim 3)."""
    contact = data._impl.contact
    depth = jnp.subtract(contact.dist, contact.includemargin)
    touching = depth < 0.0
    first, second = jnp.asarray(model.geom_bodyid)[contact.geom].T
    weight = model.body_invweight0[first, 0] + model.body_invweight0[second, 0]
    square = contact.friction[:, 0] ** 2
    weight = 2.0 * square * (1.0 + square) * weight / model.opt.impratio
    stiffness, damping, impedance = _reference(model, contact, depth)
    regularization = jnp.maximum(
        weight * (1.0 - impedance) / impedance, mujoco.mjMINVAL
    )
    return ContactRows(
        frame_w=contact.frame * touching[:, None, None],
        point_w=contact.pos,
        friction=contact.friction[:, :2],
        D=1.0 / regularization,
        aref=-stiffness * impedance * jnp.where(touching, depth, 0.0),
        damping=damping,
    )


def _reference(
    model: mjx.Model, contact: mjx.Contact, depth: Array
) -> tuple[Array, Array, Array]:
    """Stiffness, damping and impedance [C] (MuJoCo, "solver parameters")."""
    first, ratio = jnp.asarray(contact.solref).T
    time = first
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        time = jnp.maximum(time, 2.0 * model.opt.timestep)
    low, high, width, middle, power = jnp.asarray(contact.solimp).T
    least, most = mujoco.mjMINIMP, mujoco.mjMAXIMP
    low, high = jnp.clip(low, least, most), jnp.clip(high, least, most)
    middle = jnp.clip(middle, least, most)
    power = jnp.maximum(1.0, power)
    stiffness = 1.0 / jnp.square(high * time * ratio)
    damping = 2.0 / (high * time)
    # Numbers that are not positive are stiffness and damping themselves.
    stiffness = jnp.where(first <= 0.0, -first / high**2, stiffness)
    damping = jnp.where(ratio <= 0.0, -ratio / high, damping)
    x = jnp.abs(depth) / jnp.maximum(mujoco.mjMINVAL, width)
    rising = x**power / middle ** (power - 1.0)
    ending = 1.0 - (1.0 - x) ** power / (1.0 - middle) ** (power - 1.0)
    y = jnp.where(x < middle, rising, ending)
    impedance = jnp.clip(low + y * (high - low), low, high)
    impedance = jnp.where(x > 1.0, high, impedance)
    return stiffness, damping, impedance  # pyright: ignore[reportReturnType]
