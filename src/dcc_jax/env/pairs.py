"""What the discriminator sees of a state, and pairs of it as points in space."""

from __future__ import annotations

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


def seen(bodies: Array, sliding: Array, velocity_time: float) -> Array:
    """What the discriminator sees of a state, [..., 272].

    Departure: the paper has the bodies alone. There a sole that slides at 10 cm/s is
    less than can be told apart, but the eye sees it.

    Args:
        bodies: `body_features` [..., 270].
        sliding: of both feet, `mechanics.sliding` [..., 2] m/s.
        velocity_time: of `weighed`, s.
    """
    return jnp.concatenate([weighed(bodies, velocity_time), sliding], axis=-1)


def weighed(bodies: Array, velocity_time: float) -> Array:
    """`body_features` [..., 270] with velocities and rates times `velocity_time`.

    Args:
        bodies: [..., 270].
        velocity_time: s, 1 m/s counts as much as this many m.
    """
    one = np.repeat([1.0, velocity_time, 1.0, velocity_time], [3, 3, 6, 6])
    return bodies * jnp.asarray(np.tile(one, len(BODIES)), bodies.dtype)


def pair_coordinates(s: Array, s_next: Array, velocity_time: float) -> Array:
    """A pair of what is `seen` as a point [..., 225] in m, by Euclidean distance.

    A body contributes its position, its two columns times `COLUMN_ARM`, and its
    velocity in s' and in s times `VELOCITY_TIME`. All is divided by the root of the
    number of bodies: the distance of two points is a root mean square over the bodies.

    Args:
        s: [..., 272] of `seen`; how the soles slide is left out.
        s_next: [..., 272], a control step later.
        velocity_time: of both, s.
    """
    before, now = (
        x[..., :FEATURE_SIZE].reshape(*x.shape[:-1], -1, BODY_FEATURE_SIZE)
        for x in (s, s_next)
    )
    parts = [
        now[..., 0:3],
        COLUMN_ARM * now[..., 6:12],
        VELOCITY_TIME / velocity_time * now[..., 3:6],
        VELOCITY_TIME / velocity_time * before[..., 3:6],
    ]
    points = jnp.concatenate(parts, axis=-1) / np.sqrt(now.shape[-2])
    return points.reshape(*points.shape[:-2], -1)
