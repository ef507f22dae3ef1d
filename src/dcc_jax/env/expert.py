"""What the clips show: the discriminator's examples and what to do at a moment.

Everything is written for ONE environment.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.character import Character
from dcc_jax.env import features, mechanics
from dcc_jax.env.features import Kinematics
from dcc_jax.env.mechanics import Mechanics
from dcc_jax.env.pairs import Weights, seen
from dcc_jax.motion.reference import References

Array = jax.Array


def pairs(
    tables: Mechanics,
    references: References,
    key: Array,
    spans: Array,
    weights: Weights,
) -> tuple[Array, Array, Array]:
    """(s, s') ~ M: what is `seen` [n, 272] of clips, now and `spans` [n] control steps
    later, and the clip's phase [n] then."""
    windows, phase = references.sample_windows(key, spans)

    before, q = windows[:, 0::2], windows[:, 1::2]  # [n, 2, 55]: of s and of s'
    of_both = jax.vmap(jax.vmap(lambda q, q0: of_pose(tables, q, q0, weights)))
    both = of_both(q, before)
    return both[:, 0], both[:, 1], phase


def of_pose(tables: Mechanics, q: Array, q_previous: Array, weights: Weights) -> Array:
    """What is `seen` [272] of a pose of a clip, which nothing displaces.

    Args:
        tables: of the character.
        q: now [55], its height above the ground.
        q_previous: the same, one control step ago.
        weights: of `pairs.weighed`.
    """
    bodies = features.body_features(tables.kinematics, q, q_previous)
    return seen(bodies, mechanics.sliding(tables, q, q_previous), weights)


def lead(character: Character, control_dt: float) -> float:
    """How far ahead, in s, an action has to ask for a pose so that a PD is there now.

    Half a control step, for which the target is held, and kv / kp: a PD with its target
    at rest lags by that much behind a steady motion.
    """
    joints = character.kp > 0.0
    return 0.5 * control_dt + float(
        np.mean(character.kv[joints] / character.kp[joints])
    )


def action(kinematics: Kinematics, base: Array, wanted: Array) -> Array:
    """The rotation vectors [36], rad, that take the pose `base` [55] to `wanted`."""
    _, there = kinematics.coords.split_q(wanted)
    _, here = kinematics.coords.split_q(base)
    return quat.log(quat.mul(quat.inv(here), there))[1:].reshape(-1)


def nominal_pose(references: References) -> Array:
    """The pose [55] that the zero action asks for: mean joint rotations of the clips.

    Departure: the paper's action is q_bar itself. Around the mean pose the untrained
    policy stands about like the clips do, and the rotation vectors stay small.
    """
    frames = jnp.arange(references.qpos.shape[1]) < references.frames[:, None]
    tangents = quat.log_map(references.coords, references.qpos)
    weight = frames[..., None] / frames.sum()
    mean = jnp.sum(weight * tangents, axis=(0, 1)).at[:6].set(0.0)
    return quat.exp_map(references.coords, mean)
