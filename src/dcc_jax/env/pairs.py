"""What the discriminator sees of a state, and pairs of it as points in space."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.character import BODIES, FEET
from dcc_jax.env.features import BODY_FEATURE_SIZE, FEATURE_SIZE

Array = jax.Array

COLUMN_ARM = 0.1  # m; a body turned by 1 rad is about 0.14 m away
VELOCITY_TIME = 0.1  # s; a body faster by 1 m/s is 0.1 m away

SEEN_SIZE = FEATURE_SIZE + len(FEET)
"""Numbers that the discriminator sees of a state, 272."""


@dataclass(frozen=True)
class Weights:
    """How much each kind of number counts beside a position in m."""

    velocity_time: float  # s; 1 m/s counts as much as this many m
    turn_arm: float  # m; an entry of a column, of length 1, counts as much


def seen(bodies: Array, sliding: Array, weights: Weights) -> Array:
    """What the discriminator sees of a state, [..., 272].

    Departure: the paper has the bodies alone. There a sole that slides at 10 cm/s is
    less than can be told apart, but the eye sees it.

    Args:
        bodies: `body_features` [..., 270].
        sliding: of both feet, `mechanics.sliding` [..., 2] m/s.
        weights: of `weighed`.
    """
    return jnp.concatenate([weighed(bodies, weights), sliding], axis=-1)


def weighed(bodies: Array, weights: Weights) -> Array:
    """`body_features` [..., 270] as lengths in m, by the weights.

    Args:
        bodies: [..., 270].
        weights: of velocities, of columns, and of both for rates.
    """
    time, arm = weights.velocity_time, weights.turn_arm
    one = np.repeat([1.0, time, arm, arm * time], [3, 3, 6, 6])
    return bodies * jnp.asarray(np.tile(one, len(BODIES)), bodies.dtype)


def pair_coordinates(s: Array, s_next: Array, weights: Weights) -> Array:
    """A pair of what is `seen` as a point [..., 225] in m, by Euclidean distance.

    A body contributes its position, its two columns times `COLUMN_ARM`, and its
    velocity in s' and in s times `VELOCITY_TIME`. All is divided by the root of the
    number of bodies: the distance of two points is a root mean square over the bodies.

    Args:
        s: [..., 272] of `seen`; how the soles slide is left out.
        s_next: [..., 272], a control step later.
        weights: of both.
    """
    before, now = (
        x[..., :FEATURE_SIZE].reshape(*x.shape[:-1], -1, BODY_FEATURE_SIZE)
        for x in (s, s_next)
    )
    parts = [
        now[..., 0:3],
        COLUMN_ARM / weights.turn_arm * now[..., 6:12],
        VELOCITY_TIME / weights.velocity_time * now[..., 3:6],
        VELOCITY_TIME / weights.velocity_time * before[..., 3:6],
    ]
    points = jnp.concatenate(parts, axis=-1) / np.sqrt(now.shape[-2])
    return points.reshape(*points.shape[:-2], -1)
