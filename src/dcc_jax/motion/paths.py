"""A path to follow: standing, walking, jogging, running, with turns, drawn as it goes.

Within a control step the acceleration and the turning rate are constant, so the motion
is that of the step's beginning and these two. Everything is pure and of ONE partner.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import draws
from dcc_jax.character import CONTROL_DT, CONTROL_RATE

Array = jax.Array


SWAY = 0.3
"""m/s; who is slower sways on the spot, and his velocity points nowhere."""


@flax.struct.dataclass
class Motion:
    """The partner at `time`, what it does in this control step, and what it wants."""

    time: Array  # [] s since the reset
    position: Array  # [2] m, world
    heading: Array  # [] rad, direction of the path
    speed: Array  # [] m/s
    acceleration: Array  # [] m/s^2
    turn: Array  # [] rad/s
    wanted_speed: Array  # [] m/s
    wanted_turn: Array  # [] rad/s
    left: Array  # [] s until it wants something else


@dataclass(frozen=True)
class Gaits:
    """What a partner does."""

    speeds: tuple[float, ...] = (0.0, 1.2, 2.0, 3.0)
    """m/s; it stops, walks, jogs or runs, as fast as the clips do."""
    leg_time: tuple[float, float] = (1.5, 3.5)
    """s for which it wants the same."""
    acceleration: float = 1.5
    """m/s^2, at most: a run begins within two seconds."""
    turn_rate: float = 0.5
    """rad/s, at most."""
    turn_acceleration: float = 1.5
    """rad/s^2, at most."""
    sideways: float = 1.0
    """m/s^2, at most, to the inside of a turn: a run turns less than a walk."""


def begin(
    key: Array,
    gaits: Gaits,
    position: Array,
    velocity: Array,
    facing: Array,
    slowest: float = SWAY,
) -> Motion:
    """A partner that goes on for a while as the reference does at the reset.

    Args:
        key: consumed.
        gaits: what it may do later.
        position: of the path [2], m, world.
        velocity: along it [2], m/s. Below `slowest` it stands, and will go where it
            faces.
        facing: heading of the reference, rad.
        slowest: m/s.
    """
    speed = length(velocity)
    goes = speed > slowest
    heading = jnp.where(goes, jnp.arctan2(velocity[1], velocity[0]), facing)
    speed = jnp.where(goes, speed, 0.0)
    zero = jnp.zeros(())
    return Motion(
        # One step back: the first control step then begins at the reset.
        time=zero - CONTROL_DT,
        position=position - CONTROL_DT * speed * direction(heading),
        heading=heading,
        speed=speed,
        acceleration=zero,
        turn=zero,
        wanted_speed=speed,
        wanted_turn=zero,
        left=jax.random.uniform(key, maxval=gaits.leg_time[0]),
    )


def go_on(key: Array, gaits: Gaits, motion: Motion) -> Motion:
    """One control step later; now and then the partner wants something else."""
    motion = _wanting(key, gaits, _advanced(motion))
    reach = gaits.acceleration * CONTROL_DT
    faster = jnp.clip(motion.wanted_speed - motion.speed, -reach, reach)
    tightest = gaits.sideways / jnp.maximum(motion.speed, 0.1)
    # Who stands does not turn.
    tightest = jnp.minimum(tightest, gaits.turn_rate * motion.speed)
    wanted_turn = jnp.clip(motion.wanted_turn, -tightest, tightest)
    reach = gaits.turn_acceleration * CONTROL_DT
    return dataclasses.replace(
        motion,
        acceleration=faster / CONTROL_DT,
        turn=motion.turn + jnp.clip(wanted_turn - motion.turn, -reach, reach),
    )


def leashed(motion: Motion, root: Array, leash: float) -> Motion:
    """The same from within `leash` m of a root [2], m: who is left behind is waited
    for, and who is carried off is followed."""
    away = motion.position - root
    within = jnp.minimum(1.0, leash / length(away))
    return dataclasses.replace(motion, position=root + within * away)


def path(motion: Motion, time: Array) -> tuple[Array, Array, Array]:
    """Position [2], heading [] and speed [] at a moment of the control step."""
    elapsed = time - motion.time
    covered = elapsed * (motion.speed + 0.5 * elapsed * motion.acceleration)
    middle = motion.heading + 0.5 * elapsed * motion.turn
    return (
        motion.position + covered * direction(middle),
        motion.heading + elapsed * motion.turn,
        motion.speed + elapsed * motion.acceleration,
    )


def end(motion: Motion) -> Array:
    """The end of the control step in s, when it is judged and observed."""
    return whole_steps(motion.time + CONTROL_DT)


def whole_steps(time: Array) -> Array:
    """The nearest whole number of control steps, s: sums of float32 drift from it, by
    half a second in ten minutes."""
    return jnp.round(time * CONTROL_RATE) / CONTROL_RATE


def length(vector: Array) -> Array:
    """|vector| [], differentiable at zero."""
    return jnp.sqrt(jnp.sum(jnp.square(vector)) + 1e-12)


def direction(heading: Array) -> Array:
    """The unit vector [2] of a heading in rad."""
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)])


def to_path(point: Array, root: Array, heading: Array) -> Array:
    """A point [3] of the world seen from a point [2] of the path: ahead, left, up."""
    along = direction(heading)
    offset = point[:2] - root
    across = along[0] * offset[1] - along[1] * offset[0]
    return jnp.stack([along @ offset, across, point[2]])


def from_path(offset: Array, root: Array, heading: Array) -> Array:
    """The inverse of `to_path`."""
    along = direction(heading)
    across = jnp.stack([-along[1], along[0]])
    return jnp.append(root + offset[0] * along + offset[1] * across, offset[2])


def _advanced(motion: Motion) -> Motion:
    now = end(motion)
    position, heading, speed = path(motion, now)
    return dataclasses.replace(
        motion, time=now, position=position, heading=heading, speed=speed
    )


def _wanting(key: Array, gaits: Gaits, motion: Motion) -> Motion:
    count = len(gaits.speeds)
    which, turn, left = draws.uniform(
        key, (0.0, count), (-gaits.turn_rate, gaits.turn_rate), gaits.leg_time
    )
    due = motion.left <= 0.0
    speed = jnp.array(gaits.speeds)[which.astype(jnp.int32)]
    return dataclasses.replace(
        motion,
        wanted_speed=jnp.where(due, speed, motion.wanted_speed),
        wanted_turn=jnp.where(due, turn, motion.wanted_turn),
        left=jnp.where(due, left, motion.left - CONTROL_DT),
    )
