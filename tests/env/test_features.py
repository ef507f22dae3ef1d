"""features.py against C MuJoCo's kinematics, and its invariances."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax.character import CONTROL_DT, load_character
from dcc_jax.env import features

CHARACTER = load_character()
MODEL = CHARACTER.spec().compile()
KINEMATICS = features.Kinematics.of(MODEL)
COORDS = KINEMATICS.coords
HAND = CHARACTER.body_names.index("left_hand")
BATCH = 100
IDENTITY = np.zeros((BATCH, MODEL.nq))
IDENTITY[:, COORDS.quat_qpos[:, 0]] = 1.0


@jax.jit
@jax.vmap
@chex.assert_max_traces(1)
def states(q, q_previous, u, u_previous):
    """`features.state` of BATCH environments; one program serves every test."""
    return features.state(KINEMATICS, q, q_previous, u, u_previous)


def body_features(q: np.ndarray, q_previous: np.ndarray) -> np.ndarray:
    """The bodies' part of the state of undisplaced poses [n, 55], as [n, 15, 18]."""
    padded = [np.resize(x, (BATCH, MODEL.nq)) for x in (q, q_previous)]
    values = states(
        *(jnp.asarray(x, jnp.float32) for x in (*padded, IDENTITY, IDENTITY))
    )
    return np.asarray(values)[: len(q), :270].reshape(-1, 15, 18)


def over_a_step(bodies: np.ndarray) -> np.ndarray:
    """The bodies' part [..., 15, 18] with changes over a control step, not rates."""
    return bodies * np.repeat([1.0, CONTROL_DT, 1.0, CONTROL_DT], [3, 3, 6, 6])


def random_poses(seed: int, spread: float) -> np.ndarray:
    """BATCH random poses around the origin, [BATCH, 55]."""
    rng = np.random.default_rng(seed)
    q = np.tile(MODEL.qpos0, (BATCH, 1))
    for row in q:
        mujoco.mj_integratePos(MODEL, row, rng.normal(0.0, spread, MODEL.nv), 1.0)
    return q


def displaced(q: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """q (+) exp(tangents) by MuJoCo, whose tangent is ours, [BATCH, 55]."""
    moved = q.copy()
    for row, tangent in zip(moved, tangents, strict=True):
        mujoco.mj_integratePos(MODEL, row, tangent, 1.0)
    return moved


def random_tangents(seed: int) -> np.ndarray:
    """Of displacements of the joints and of the root on the ground, [BATCH, 42]."""
    tangents = np.random.default_rng(seed).normal(0.0, 0.3, (BATCH, MODEL.nv))
    tangents[:, 2:6] = 0.0
    return tangents


def carried(q: np.ndarray, turn: float, shift: tuple[float, float]) -> np.ndarray:
    """The pose [55] turned about the world's vertical, then shifted on the ground."""
    rotation = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    moved = q.copy()
    mujoco.mju_rotVecQuat(moved[:3], q[:3], rotation)
    mujoco.mju_mulQuat(moved[3:7], rotation, q[3:7])
    moved[:2] += shift
    return moved


def mujoco_poses(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(MODEL)
    positions, quats = [], []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(MODEL, data)
        positions.append(data.xpos[1:].copy())
        quats.append(data.xquat[1:].copy())
    return np.array(positions), np.array(quats)


def test_body_poses_equal_mujocos():
    q = random_poses(0, spread=1.5)
    with jax.enable_x64(True):
        poses = jax.jit(jax.vmap(lambda q: features.body_poses(KINEMATICS, q)))
        positions, quats = poses(jnp.asarray(q))
    expected_positions, expected_quats = mujoco_poses(q)
    np.testing.assert_allclose(positions, expected_positions, atol=1e-12)
    np.testing.assert_allclose(quats, expected_quats, atol=1e-12)


def test_features_of_random_poses_equal_mujocos_seen_from_the_root():
    q, q_previous = random_poses(1, 0.5), random_poses(2, 0.5)
    (now, now_quat), (then, then_quat) = mujoco_poses(q), mujoco_poses(q_previous)
    for i, bodies in enumerate(body_features(q, q_previous)):
        forward = np.zeros(3)
        mujoco.mju_rotVecQuat(forward, np.array([1.0, 0.0, 0.0]), q[i, 3:7])
        c, s = forward[:2] / np.hypot(*forward[:2])
        to_local = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        origin = np.array([*q[i, :2], 0.0])
        position, moved = (now[i] - origin) @ to_local.T, (now - then)[i] @ to_local.T
        columns = np.zeros((2, 15, 6))
        for row, orientations in zip(columns, (now_quat[i], then_quat[i]), strict=True):
            for body, orientation in enumerate(orientations):
                matrix = np.zeros(9)
                mujoco.mju_quat2Mat(matrix, orientation)
                row[body] = (to_local @ matrix.reshape(3, 3))[:, :2].T.ravel()
        expected = position, moved, columns[0], columns[0] - columns[1]
        np.testing.assert_allclose(over_a_step(bodies), np.hstack(expected), atol=1e-5)


def test_features_of_the_t_pose_by_hand():
    q = MODEL.qpos0.copy()
    q[:2] = (3.0, -2.0)
    previous = q.copy()
    previous[0] -= 0.1
    (bodies,) = body_features(q[None], previous[None])
    columns, forward = [1, 0, 0, 0, 1, 0], [0.1 / CONTROL_DT, 0, 0]
    np.testing.assert_allclose(
        bodies[0], [0, 0, 0.935, *forward, *columns, *np.zeros(6)], atol=1e-5
    )
    height = 0.935 + 0.12 + 0.28
    np.testing.assert_allclose(bodies[HAND, :6], [0, 0.69, height, *forward], atol=1e-5)


def test_features_see_a_turn_since_the_previous_step():
    q = MODEL.qpos0[None]
    ((*_, hand),) = body_features(q, carried(q[0], -0.3, (0.0, 0.0))[None])[
        :, : HAND + 1
    ]
    s, c = np.sin(0.3), np.cos(0.3)
    hand = over_a_step(hand)
    np.testing.assert_allclose(hand[3:5], [-0.69 * s, 0.69 * (1.0 - c)], atol=1e-6)
    np.testing.assert_allclose(
        hand[12:], [1.0 - c, s, 0.0, -s, 1.0 - c, 0.0], atol=1e-6
    )


def test_features_do_not_change_with_heading_and_place_on_the_ground():
    rng = np.random.default_rng(4)
    q, previous = random_poses(5, 0.4), random_poses(6, 0.4)
    moves = [(rng.uniform(-np.pi, np.pi), tuple(rng.normal(0, 2, 2))) for _ in q]
    q_there = np.array([carried(x, *move) for x, move in zip(q, moves, strict=True)])
    previous_there = np.array(
        [carried(x, *move) for x, move in zip(previous, moves, strict=True)]
    )
    here, there = body_features(q, previous), body_features(q_there, previous_there)
    np.testing.assert_allclose(over_a_step(here), over_a_step(there), atol=1e-5)


def test_features_do_change_with_height_and_tilt():
    q = random_poses(7, 0.3)[:1]
    higher, tilted = q.copy(), q.copy()
    higher[0, 2] += 0.1
    tilt = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    mujoco.mju_mulQuat(tilted[0, 3:7], tilt, q[0, 3:7])
    here = body_features(q, q)
    assert np.abs(here - body_features(higher, q)).max() > 0.09
    assert np.abs(here - body_features(tilted, q)).max() > 0.09


def test_features_are_continuous_along_a_turning_motion_and_blind_to_quaternion_signs():
    velocity = np.random.default_rng(8).normal(0.0, 0.5, MODEL.nv)
    velocity[3:6] = (0.0, 0.0, 2.5)
    q, frames = MODEL.qpos0.copy(), []
    for _ in range(BATCH):
        mujoco.mj_integratePos(MODEL, q, velocity, 0.02)
        frames.append(q.copy())
    frames = np.array(frames)
    values = body_features(frames, frames)
    assert np.abs(np.diff(values, axis=0)).max() < 0.15
    frames[1::2, COORDS.quat_qpos] *= -1.0
    np.testing.assert_allclose(body_features(frames, frames), values, atol=1e-5)


def test_state_of_a_character_that_follows_the_displaced_clip_is_the_clips():
    q_m, q_m_previous = random_poses(9, 0.3), random_poses(10, 0.3)
    v, v_previous = random_tangents(11), random_tangents(12)
    poses = (displaced(q_m, v), displaced(q_m_previous, v_previous))
    displacements = (displaced(IDENTITY, v), displaced(IDENTITY, v_previous))
    value = states(*(jnp.asarray(x, jnp.float32) for x in (*poses, *displacements)))
    assert value.shape == (BATCH, 306)
    clip = body_features(q_m, q_m_previous)
    bodies = value[:, :270].reshape(clip.shape)
    np.testing.assert_allclose(over_a_step(bodies), over_a_step(clip), atol=1e-5)
    np.testing.assert_allclose(value[:, 270:], v[:, 6:], atol=1e-6)


def test_policy_and_discriminator_see_the_same_bodies():
    q, previous = (jnp.asarray(random_poses(s, 0.8)[0], jnp.float32) for s in (13, 14))
    alone = jax.jit(lambda q, p: features.body_features(KINEMATICS, q, p))(q, previous)
    assert alone.shape == (270,)
    batched = body_features(np.asarray(q)[None], np.asarray(previous)[None])
    np.testing.assert_allclose(alone, batched.ravel(), atol=5e-6 / CONTROL_DT)


ROOT = '<body name="trunk"><freejoint/><geom size=".1"/>{}</body>'
ARM = '<body name="arm" {}><joint {}/><geom size=".1"/></body>'


@pytest.mark.parametrize(
    ("bodies", "reason"),
    [
        ('<body name="arm"><geom size=".1"/></body>', "'arm' must have one free joint"),
        (ROOT.format(ARM.format("", "")), "'arm' must have a ball joint or none"),
        (ROOT.format(ARM.format("", 'type="ball" pos="0 0 1"')), "at its origin"),
        (ROOT.format(ARM.format('euler="9 0 0"', 'type="ball"')), "rest unrotated"),
        (ROOT.format("") + ARM.format("", 'type="ball"'), "'arm' is a second root"),
    ],
)
def test_a_tree_of_another_kind_is_refused_by_name(bodies, reason):
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=reason):
        features.Kinematics.of(model)
