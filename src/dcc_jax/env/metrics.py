"""What a control step cost: forces, torques and u, measured at the physics rate."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import quat
from dcc_jax.control import ranges
from dcc_jax.control.compliance import acting
from dcc_jax.control.ranges import Room

Array = jax.Array


@flax.struct.dataclass
class Metrics:
    """Of one control step.

    Forces are those passed to the compliance controller; while a task's gate is closed
    there are none. Torques include the stable PD's implicit damping term.
    """

    force_peak: Array  # [] N, largest sum of the norms of all forces
    impulse: Array  # [] N s, integral of that sum
    contact_share: Array  # [] share of the physics steps in which a force acts
    torque_rms: Array  # [] N m, over the joints' axes and the physics steps
    contact_torque: Array  # [] N m, the same over the steps in which a force acts
    torque_peak: Array  # [] N m, of one axis
    power: Array  # [] W, mean of the sum of |torque x speed| over the axes
    displacement: Array  # [] rad, norm of log u over the joints
    root_displacement: Array  # [] m, of u
    range_share: (
        Array  # [] share of the time in which the joint ranges soften the yield
    )


def no_metrics() -> Metrics:
    """Of an environment that was just reset."""
    return Metrics(*[jnp.zeros(()) for _ in Metrics.__dataclass_fields__])


@flax.struct.dataclass
class Sums:
    """Carried through the physics steps of a control step."""

    force_peak: Array  # [] N
    impulse: Array  # [] N s
    contact_steps: Array  # []
    torque_square: Array  # [] N^2 m^2, sum over steps of the mean over axes
    contact_torque_square: Array  # [] the same over steps in which a force acts
    torque_peak: Array  # [] N m
    power: Array  # [] W, sum over steps


def no_sums(like: Array) -> Sums:
    """Before the first physics step, as many zeros as there are numbers `like`.

    Under vmap a plain zero is not batched; what a loop makes of it is, and jax would
    batch the whole loop twice to find that out.
    """
    return Sums(*[0.0 * like for _ in Sums.__dataclass_fields__])


def add(sums: Sums, force: Array, torque: Array, speed: Array, h: float) -> Sums:
    """The sums after one more physics step.

    Args:
        sums: before it.
        force: passed to the compliance controller [F, 3], N.
        torque: of the joints' axes [36], N m.
        speed: of the same axes [36], rad/s.
        h: physics step, s.
    """
    acts = acting(force)
    size = jnp.sum(jnp.sqrt(jnp.sum(jnp.square(force), axis=-1)))
    square = jnp.mean(jnp.square(torque))
    return Sums(
        force_peak=jnp.maximum(sums.force_peak, size),
        impulse=sums.impulse + h * size,
        contact_steps=sums.contact_steps + acts,
        torque_square=sums.torque_square + square,
        contact_torque_square=sums.contact_torque_square + acts * square,
        torque_peak=jnp.maximum(sums.torque_peak, jnp.max(jnp.abs(torque))),
        power=sums.power + jnp.sum(jnp.abs(torque * speed)),
    )


def metrics(
    sums: Sums,
    steps: int,
    coords: quat.Coordinates,
    u: Array,
    yielded: Array,
    room: Room | None,
) -> Metrics:
    """Of a control step.

    Args:
        sums: of its physics steps.
        steps: how many they are.
        coords: of the character.
        u: displacement [55] at its end.
        yielded: `Environment.yielded` [55].
        room: what the reference leaves of the joint ranges.
    """
    contact = jnp.maximum(sums.contact_steps, 1.0)
    log_u = quat.log_map(coords, u)
    return Metrics(
        force_peak=sums.force_peak,
        impulse=sums.impulse,
        contact_share=sums.contact_steps / steps,
        torque_rms=jnp.sqrt(sums.torque_square / steps),
        contact_torque=jnp.sqrt(sums.contact_torque_square / contact),
        torque_peak=sums.torque_peak,
        power=sums.power / steps,
        displacement=_norm(log_u[6:]),
        root_displacement=_norm(log_u[:3]),
        range_share=_softened(coords, room, yielded),
    )


def _norm(vector: Array) -> Array:
    """Exactly 0 of zeros."""
    square = jnp.sum(jnp.square(vector))
    return jnp.where(square > 0.0, jnp.sqrt(square + 1e-12), 0.0)


def _softened(coords: quat.Coordinates, room: Room | None, yielded: Array) -> Array:
    if room is None:
        return jnp.zeros(())
    return ranges.softened(coords, room, yielded).astype(yielded.dtype)
