"""Inverse kinematics of the legs: hips, knees and ankles for given feet."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.frames import to_quats, to_rotation
from dcc_jax.motion.retarget.figure import FEET, SHINS, THIGHS, Figure

REACH = 0.9995  # of the straight leg, to which an ankle may be away from its hip
LEAST_BEND = 0.02  # rad, of a knee


def reach_feet(
    body: Figure,
    root: np.ndarray,
    world: np.ndarray,
    ankles: np.ndarray,
    feet: np.ndarray,
) -> np.ndarray:
    """World rotations [T, 13, 4] with the feet where they are wanted, if they reach.

    The knee bends about its own axis until the ankle is as far from the hip as wanted;
    then the whole leg turns the shortest way to it. So the plane of the leg stays.

    Args:
        body: the lengths.
        root: [T, 3] m.
        world: rotations [T, 13, 4] to start from.
        ankles: wanted positions [T, 2, 3] m.
        feet: wanted world rotations [T, 2, 4].
    """
    positions = body.positions(root, world)
    out = world.copy()
    for side in range(2):
        thigh, shin, foot = THIGHS[side], SHINS[side], FEET[side]
        hip = positions[:, thigh]
        upper = positions[:, shin] - hip
        lower = positions[:, foot] - positions[:, shin]
        old = to_rotation(world[:, thigh])
        axis = _knee_axis(upper, lower, old)
        wanted = ankles[:, side] - hip
        bend = _bend(body.leg, np.linalg.norm(wanted, axis=1))
        bending = Rotation.from_rotvec(
            axis * (bend - _angle(upper, lower, axis))[:, None]
        )
        aim = _shortest_turn(upper + bending.apply(lower), wanted)
        out[:, thigh] = to_quats(aim * old)
        out[:, shin] = to_quats(aim * bending * to_rotation(world[:, shin]))
        out[:, foot] = feet[:, side]
    return out


def _knee_axis(upper: np.ndarray, lower: np.ndarray, thigh: Rotation) -> np.ndarray:
    """Axis [T, 3] of the knee, flexion positive: the leg's normal where it is bent,
    the thigh's own y axis where it is straight."""
    own = thigh.apply([0.0, 1.0, 0.0])
    normal = (
        np.cross(upper, lower)
        / (np.linalg.norm(upper, axis=1) * np.linalg.norm(lower, axis=1))[:, None]
    )
    bent = np.clip((np.einsum("ti,ti->t", normal, own) - 0.1) / 0.3, 0.0, 1.0)[:, None]
    axis = bent * _unit(normal) + (1.0 - bent) * own
    along = _unit(upper)
    return _unit(axis - along * np.einsum("ti,ti->t", axis, along)[:, None])


def _angle(a: np.ndarray, b: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Signed angle [T] from a to b about an axis."""
    sine = np.einsum("ti,ti->t", np.cross(a, b), axis)
    along = np.einsum("ti,ti->t", a, axis) * np.einsum("ti,ti->t", b, axis)
    return np.arctan2(sine, np.einsum("ti,ti->t", a, b) - along)


def _bend(leg: tuple[float, float], distance: np.ndarray) -> np.ndarray:
    """Knee flexion [T] in rad at which hip and ankle are `distance` apart."""
    upper, lower = leg
    far = REACH * (upper + lower)
    distance = np.clip(distance, 0.2 * far, far)
    cosine = (distance**2 - upper**2 - lower**2) / (2.0 * upper * lower)
    return np.maximum(np.arccos(np.clip(cosine, -1.0, 1.0)), LEAST_BEND)


def _shortest_turn(a: np.ndarray, b: np.ndarray) -> Rotation:
    """The rotation [T] about the common normal that takes a's direction to b's."""
    a, b = _unit(a), _unit(b)
    half = _unit(a + b)
    imag = np.cross(a, half)
    real = np.einsum("ti,ti->t", a, half)
    return Rotation.from_quat(np.concatenate([imag, real[:, None]], axis=1))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
