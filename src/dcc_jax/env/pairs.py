"""Pairs (s, s') of body features as points in space, for distances between motions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.env.features import BODY_FEATURE_SIZE

Array = jax.Array

COLUMN_ARM = 0.1  # m; a body turned by 1 rad is about 0.14 m away
VELOCITY_TIME = 0.1  # s; a body faster by 1 m/s is 0.1 m away


def pair_coordinates(s: Array, s_next: Array, dt: float) -> Array:
    """A pair of `body_features` as a point [..., 225] in m; Euclidean distances count.

    A body contributes its position, its two columns times `COLUMN_ARM`, and its
    velocity in s' and in s times `VELOCITY_TIME`. All is divided by the root of the
    number of bodies: the distance of two points is a root mean square over the bodies.

    Args:
        s: [..., 270].
        s_next: [..., 270], a control step later.
        dt: control step, s.
    """
    before = s.reshape(*s.shape[:-1], -1, BODY_FEATURE_SIZE)
    now = s_next.reshape(*s_next.shape[:-1], -1, BODY_FEATURE_SIZE)
    parts = [
        now[..., 0:3],
        COLUMN_ARM * now[..., 6:12],
        VELOCITY_TIME / dt * (now[..., 0:3] - now[..., 3:6]),
        VELOCITY_TIME / dt * (before[..., 0:3] - before[..., 3:6]),
    ]
    points = jnp.concatenate(parts, axis=-1) / np.sqrt(now.shape[-2])
    return points.reshape(*points.shape[:-2], -1)
