"""The law `admittance` by hand, its bounds, and the room of the joint ranges."""

from __future__ import annotations

import math

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import quat
from dcc_jax.character import asset_path, load_character
from dcc_jax.control import compliance, ranges
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.motion.clip import load_clip

CHARACTER = load_character()
MODEL = CHARACTER.spec().compile()
COORDS = quat.Coordinates.of(MODEL)
DT = 1.0 / 240.0
CONTROLLER = compliance.Controller.of(ComplianceConfig(), CHARACTER, COORDS, DT)
REST = compliance.at_rest(COORDS)
BATCH, STEPS = 64, 240
HAND = 1 + CHARACTER.body_names.index("left_hand")
CLIPS = ("stand", "walk_cycle", "run_cycle", "backflip", "door")


@jax.jit
@jax.vmap
@chex.assert_max_traces(1)
def course(q_m, J, force, alpha, seconds):
    """A force for some seconds, then none: u at the end, log u [STEPS, 42]."""
    room = CONTROLLER.room(q_m)

    def step(displacement, index):
        f = force * (index * DT < seconds)
        displacement = compliance.admittance(
            CONTROLLER, displacement, f @ J, alpha, room
        )
        return displacement, quat.log_map(COORDS, displacement.u)

    end, path = jax.lax.scan(step, REST, jnp.arange(STEPS))
    return end, path


def jacobian(q: np.ndarray, body: int) -> np.ndarray:
    """J [3, 42] of a body's origin, by C MuJoCo."""
    data, J = mujoco.MjData(MODEL), np.zeros((3, MODEL.nv))
    data.qpos[:] = q
    mujoco.mj_forward(MODEL, data)
    mujoco.mj_jac(MODEL, data, J, None, data.xpos[body], body)
    return J


def pushed(newtons: float, alpha: float, seconds: float = 9.0):
    """Poses of the clips, pushed at random bodies in random directions.

    Returns q_m, J, forces, and what `course` gives.
    """
    rng = np.random.default_rng(0)
    poses = np.concatenate(
        [load_clip(asset_path(f"motions/{c}.npz")).qpos for c in CLIPS]
    )
    q_m = poses[rng.integers(0, len(poses), BATCH)]
    J = np.stack([jacobian(q, int(rng.integers(1, MODEL.nbody))) for q in q_m])
    force = rng.normal(size=(BATCH, 3))
    force *= newtons / np.linalg.norm(force, axis=1, keepdims=True)
    given = [np.asarray(x, np.float32) for x in (q_m, J, force)]
    full = [np.full(BATCH, x, np.float32) for x in (alpha, seconds)]
    return q_m, J, force, course(*given, *full)


def test_constant_force_rests_where_eq_6_and_7_have_it():
    # So weak that no joint uses half of its room.
    _, J, force, (_, path) = pushed(0.5, 0.5)
    torque = np.einsum("bij,bi->bj", J, force)
    kp = np.where(CHARACTER.kp > 0.0, CHARACTER.kp, 2000.0)
    expected = CHARACTER.column_weight * torque / kp
    # A critically damped approach has (1 + w t) exp(-w t) left after a second.
    left = np.array([(1 + w) * math.exp(-w) for w in (math.sqrt(60.0), 10.0)])
    expected *= 1.0 - np.repeat(left, [6, 36])
    np.testing.assert_allclose(
        path[:, -1], expected, atol=2e-3 * np.abs(expected).max()
    )


def test_a_short_contact_counts_by_its_impulse():
    alpha, newtons, seconds = 0.5, 0.5, DT
    _, J, force, (_, path) = pushed(newtons, alpha, seconds)
    torque = np.einsum("bij,bi->bj", J, force)
    kp = np.where(CHARACTER.kp > 0.0, CHARACTER.kp, 2000.0)
    rest = CHARACTER.column_weight * torque / kp
    for part, w in ((slice(6, None), 10.0), (slice(0, 2), math.sqrt(60.0))):
        # From rest, an impulse w^2 u* T gives u = w^2 u* T t exp(-w t).
        peak = w * rest[:, part] * seconds / math.e
        found = np.asarray(path)[:, :, part]
        largest = np.take_along_axis(found, np.abs(found).argmax(1)[:, None], 1)[:, 0]
        np.testing.assert_allclose(largest, peak, atol=0.06 * np.abs(peak).max())


@pytest.mark.parametrize("newtons", [0.0, 1e-9, 1.0, 180.0, 1e6])
def test_displaced_reference_stays_in_the_joint_ranges(newtons):
    q_m, _, _, (end, path) = pushed(newtons, 0.9)
    chex.assert_tree_all_finite((end, path))
    q_bar = quat.oplus(COORDS, jnp.asarray(q_m, jnp.float32), end.u)
    before = np.asarray(quat.log(COORDS.split_q(q_m)[1][:, 1:]))
    after = np.asarray(quat.log(COORDS.split_q(q_bar)[1][:, 1:]))
    assert np.all(after > np.minimum(CHARACTER.lower, before) - 1e-4)
    assert np.all(after < np.maximum(CHARACTER.upper, before) + 1e-4)
    assert np.linalg.norm(end.u[:, :2], axis=1).max() < ranges.ROOT_ROOM
    assert (np.abs(path).max() > 0.0) == (newtons > 0.0)


@pytest.mark.parametrize("newtons", [1.0, 180.0, 1e6])
def test_nobody_yields_against_the_force(newtons):
    _, J, force, (_, path) = pushed(newtons, 0.9)
    yielding = np.einsum("bi,bij,bj->b", force, J, np.asarray(path)[:, -1])
    assert yielding.min() > 0.0


def test_level_zero_is_exactly_inert():
    *_, (end, path) = pushed(1e6, 0.0)
    np.testing.assert_array_equal(path, 0.0)
    chex.assert_trees_all_equal(end.u, jnp.tile(REST.u, (BATCH, 1)))


def test_straight_arm_pulled_along_itself_stays_finite_and_in_its_ranges():
    q_m = np.asarray(MODEL.qpos0)  # a T-pose
    force = np.tile([0.0, 1e6, 0.0], (BATCH, 1))
    J = np.tile(jacobian(q_m, HAND), (BATCH, 1, 1))
    given = [np.asarray(x, np.float32) for x in (np.tile(q_m, (BATCH, 1)), J, force)]
    full = [np.full(BATCH, x, np.float32) for x in (0.9, 9.0)]
    end, path = course(*given, *full)
    chex.assert_tree_all_finite((end, path))
    turned = np.asarray(path)[0, -1, 6:].reshape(12, 3)
    assert np.all((turned > CHARACTER.lower) & (turned < CHARACTER.upper))


def test_half_of_the_room_is_used_as_the_law_says_and_the_rest_is_approached():
    room = CONTROLLER.room(jnp.asarray(MODEL.qpos0, jnp.float32))
    elbow = CHARACTER.joint_names.index("left_elbow")
    upper = CHARACTER.upper[elbow, 2]

    def kept(share: float) -> float:
        rest = np.zeros(MODEL.nv, np.float32)
        rest[6 + 3 * elbow + 2] = share * upper
        return float(ranges.bounded(COORDS, room, rest)[6 + 3 * elbow + 2] / upper)

    shares = np.array([0.1, 0.3, 0.49, 0.51, 1.0, 3.0, 100.0])
    found = np.array([kept(share) for share in shares])
    np.testing.assert_allclose(found[:3], shares[:3], rtol=1e-5)
    assert np.all(np.diff(found) > 0.0) and found[-1] < 1.0
    assert found[3] == pytest.approx(0.51, abs=1e-3)  # no kink


def test_inverse_right_jacobian_is_how_the_logarithm_changes():
    rng = np.random.default_rng(1)
    r, w = rng.uniform(-1.6, 1.6, (2, 200, 3))
    r[:3] *= 1e-4
    with jax.enable_x64(True):
        q = quat.exp(jnp.asarray(r))

        def turned(t):
            return quat.log(quat.mul(q, quat.exp(t * jnp.asarray(w))))

        _, expected = jax.jvp(turned, (0.0,), (1.0,))
        matrix = ranges.inverse_right_jacobian(jnp.asarray(r))
        found = np.einsum("jab,jb->ja", matrix, w)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_reference_outside_its_ranges_is_not_drawn_in():
    tangent = np.zeros(MODEL.nv)
    tangent[6:9] = [0.0, CHARACTER.upper[0, 1] + 0.3, 0.0]  # the spine
    q_m = MODEL.qpos0.copy()
    mujoco.mj_integratePos(MODEL, q_m, tangent, 1.0)
    room = CONTROLLER.room(jnp.asarray(q_m, jnp.float32))
    np.testing.assert_array_equal(ranges.clip(COORDS, room, REST.u), REST.u)
    back = quat.exp_map(COORDS, jnp.zeros(MODEL.nv).at[7].set(-0.2))
    np.testing.assert_allclose(ranges.clip(COORDS, room, back), back, atol=1e-6)
    beyond = quat.exp_map(COORDS, jnp.zeros(MODEL.nv).at[7].set(0.2))
    np.testing.assert_allclose(ranges.clip(COORDS, room, beyond), REST.u, atol=1e-6)


def test_no_tangent_takes_a_joint_out_of_its_ranges():
    q_m, *_ = pushed(0.0, 0.5)
    q_m = np.array(q_m, np.float32)
    q_m[0, 7:11] = np.cos(0.8), 0.0, np.sin(0.8), 0.0  # outside, and may come back
    w = 2.0 * np.random.default_rng(0).normal(size=(len(q_m), MODEL.nv))

    @jax.vmap
    def ends(q_m, w):
        room = CONTROLLER.room(q_m)
        u = ranges.displaced(COORDS, room, w)
        return room.turned(COORDS.split_q(u)[1][1:]), room.lower, room.upper

    r, lower, upper = (np.asarray(x) for x in ends(q_m, w.astype(np.float32)))
    short = np.linalg.norm(np.clip(r, lower, upper), axis=-1) < np.pi
    assert short.mean() > 0.9
    assert np.all((r > lower - 1e-5) & (r < upper + 1e-5), where=short[..., None])
    at_a_side = np.isclose(r, lower, atol=1e-5) | np.isclose(r, upper, atol=1e-5)
    assert at_a_side.any(axis=-1).mean() > 0.5


@pytest.mark.parametrize("size", [0.0, 0.01, 0.1])
def test_displacement_of_a_tangent_is_its_exponential_to_second_order(size):
    q_m = load_clip(asset_path("motions/walk_cycle.npz")).qpos.astype(np.float32)
    w = np.random.default_rng(0).normal(size=(len(q_m), MODEL.nv))
    w = size * jnp.asarray(w / np.abs(w).max(), jnp.float32)

    @jax.vmap
    def both(q_m, w):
        room, exact = CONTROLLER.room(q_m), quat.exp_map(COORDS, w)
        clear = room.used(room.turned(COORDS.split_q(exact)[1][1:]) - room.r) < 0.99
        return ranges.displaced(COORDS, room, w), exact, clear

    u, exact, clear = both(q_m, w)
    off = np.abs(quat.log_map(COORDS, u) - w)[:, 6:].reshape(*clear.shape, 3)
    off, clear = np.asarray(off).max(-1), np.asarray(clear)
    assert clear.mean() > 0.5
    assert off[clear].max() <= size**2
    np.testing.assert_allclose(u[:, :7], exact[:, :7], atol=1e-7)


def test_who_is_turned_beyond_half_a_turn_comes_back_to_the_side_where_he_left():
    hinge = 6 + 3 * CHARACTER.joint_names.index("left_elbow") + 2
    upper = CHARACTER.upper[CHARACTER.joint_names.index("left_elbow"), 2]
    bent = quat.exp_map(COORDS, jnp.zeros(MODEL.nv).at[hinge].set(upper - 0.1))
    q_m = quat.oplus(COORDS, jnp.asarray(MODEL.qpos0, jnp.float32), bent)
    for far in (0.5, 1.5, 2.5):
        u = quat.exp_map(COORDS, jnp.zeros(MODEL.nv).at[hinge].set(far))
        kept = quat.log_map(COORDS, ranges.clip(COORDS, CONTROLLER.room(q_m), u))
        assert float(kept[hinge]) == pytest.approx(0.1, abs=1e-5)


def test_more_than_half_of_a_joints_room_is_reported():
    room = CONTROLLER.room(jnp.asarray(MODEL.qpos0, jnp.float32))
    knee = 6 + 3 * CHARACTER.joint_names.index("left_knee") + 1

    def turned(share: float):
        angle = share * CHARACTER.upper[CHARACTER.joint_names.index("left_knee"), 1]
        return quat.exp_map(COORDS, jnp.zeros(MODEL.nv).at[knee].set(angle))

    assert not ranges.softened(COORDS, room, turned(0.45))
    assert ranges.softened(COORDS, room, turned(0.55))


def test_up_to_the_greatest_alpha_a_force_is_yielded_to_in_full():
    q_m = load_clip(asset_path("motions/run_cycle.npz")).qpos[5]
    J, force = jacobian(q_m, HAND)[None], np.array([[0.0, 60.0, 40.0]])
    given = [jnp.asarray(x, jnp.float32) for x in (q_m, J, force)]
    alpha = float(compliance.greatest_alpha(CONTROLLER, *given))
    assert 0.05 < alpha < 0.9
    kp = np.where(CHARACTER.kp > 0.0, CHARACTER.kp, 2000.0)

    def shortened(alpha: float) -> bool:
        softer = 1.0 + CHARACTER.column_weight * alpha / (1.0 - alpha)
        rest = jnp.asarray(softer * (J[0].T @ force[0]) / kp, jnp.float32)
        rest = rest.at[:6].set(0.0)
        kept = ranges.bounded(COORDS, CONTROLLER.room(given[0]), rest)
        return bool(np.abs(kept - rest).max() > 1e-5)

    assert not shortened(alpha - 0.01)
    assert shortened(alpha + 0.01)
