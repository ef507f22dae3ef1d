"""What the discriminator sees of a state, and pairs of it as points in space."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.character import CONTROL_DT
from dcc_jax.env.features import BODY_FEATURE_SIZE

Array = jax.Array

COLUMN_ARM = 0.1  # m; a body turned by 1 rad is about 0.14 m away
VELOCITY_TIME = 0.1  # s; a body faster by 1 m/s is 0.1 m away


def in_motion(bodies: Array, velocity_time: float) -> Array:
    """`body_features` [..., 270] with velocities instead of where bodies were.

    A body contributes its position (m), its velocity times `velocity_time` (m), its two
    columns, and their rate times `velocity_time`.

    Departure: the paper has positions and columns now and then (Sec. 4.2). Both say the
    same, but there a velocity is the small difference of two numbers that are divided
    by the spread of positions: a discriminator that is smooth, and has noise on what it
    sees, hardly sees it.

    Args:
        bodies: [..., 270].
        velocity_time: s, 1 m/s counts as much as this many m.
    """
    parts = bodies.reshape(*bodies.shape[:-1], -1, BODY_FEATURE_SIZE)
    pos, then, columns, columns_then = jnp.split(parts, [3, 6, 12], axis=-1)
    per = velocity_time / CONTROL_DT
    moving = [pos, per * (pos - then), columns, per * (columns - columns_then)]
    return jnp.concatenate(moving, axis=-1).reshape(bodies.shape)


def pair_coordinates(s: Array, s_next: Array, velocity_time: float) -> Array:
    """A pair of `in_motion` as a point [..., 225] in m; Euclidean distances count.

    A body contributes its position, its two columns times `COLUMN_ARM`, and its
    velocity in s' and in s times `VELOCITY_TIME`. All is divided by the root of the
    number of bodies: the distance of two points is a root mean square over the bodies.

    Args:
        s: [..., 270].
        s_next: [..., 270], a control step later.
        velocity_time: of both, s.
    """
    before = s.reshape(*s.shape[:-1], -1, BODY_FEATURE_SIZE)
    now = s_next.reshape(*s_next.shape[:-1], -1, BODY_FEATURE_SIZE)
    parts = [
        now[..., 0:3],
        COLUMN_ARM * now[..., 6:12],
        VELOCITY_TIME / velocity_time * now[..., 3:6],
        VELOCITY_TIME / velocity_time * before[..., 3:6],
    ]
    points = jnp.concatenate(parts, axis=-1) / np.sqrt(now.shape[-2])
    return points.reshape(*points.shape[:-2], -1)
