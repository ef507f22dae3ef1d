"""quat.py: group laws, MuJoCo's conventions, the displacement algebra of Sec. 3.4."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import quat
from dcc_jax.character import load_character

COUNT = 200
MIXED = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody>
  <body name="door"><joint type="hinge"/><geom size=".1"/>
    <body><joint type="slide"/><geom size=".1"/></body></body>
  <body name="man"><freejoint/><geom size=".1"/>
    <body><joint type="ball"/><geom size=".1"/>
      <body><joint type="hinge"/><joint type="hinge" axis="0 1 0"/><geom size=".1"/>
  </body></body></body>
</worldbody></mujoco>""")
CHARACTER = load_character().spec().compile()


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def random_quats(seed: int) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(COUNT, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def random_vectors(seed: int, size: float) -> np.ndarray:
    """Vectors [COUNT, 3] of uniform length in [0, size]."""
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(COUNT, 3))
    return (
        v
        / np.linalg.norm(v, axis=1, keepdims=True)
        * rng.uniform(0.0, size, (COUNT, 1))
    )


def random_q(model: mujoco.MjModel, seed: int) -> np.ndarray:
    """Coordinates [COUNT, nq] all over the place."""
    rng = np.random.default_rng(seed)
    q = np.tile(model.qpos0, (COUNT, 1))
    for row in q:
        mujoco.mj_integratePos(model, row, rng.normal(0.0, 1.0, model.nv), 1.0)
    return q


def row_by_row(function, size: int, *arguments: np.ndarray) -> np.ndarray:
    """MuJoCo's `function(result, *rows)` for every row, [COUNT, size]."""
    results = np.zeros((COUNT, size))
    for result, *rows in zip(results, *arguments, strict=True):
        function(result, *rows)
    return results


def test_product_inverse_rotation_and_matrix_equal_mujocos():
    a, b, v = random_quats(0), random_quats(1), random_vectors(2, 3.0)
    expected = row_by_row(mujoco.mju_mulQuat, 4, a, b)
    np.testing.assert_allclose(jax.jit(quat.mul)(a, b), expected, atol=1e-14)
    expected = row_by_row(mujoco.mju_negQuat, 4, a)
    np.testing.assert_allclose(jax.jit(quat.inv)(jnp.asarray(a)), expected, atol=1e-14)
    expected = row_by_row(lambda out, v, q: mujoco.mju_rotVecQuat(out, v, q), 3, v, a)
    np.testing.assert_allclose(jax.jit(quat.rotate)(a, v), expected, atol=1e-14)
    matrices = np.asarray(jax.jit(quat.to_matrix)(a)).reshape(COUNT, 9)
    expected = row_by_row(mujoco.mju_quat2Mat, 9, a)
    np.testing.assert_allclose(matrices, expected, atol=1e-14)


@pytest.mark.parametrize("size", [1e-12, 1e-5, 1e-3, 1.0, np.pi - 1e-6])
def test_log_undoes_exp(size):
    w = random_vectors(3, size)
    np.testing.assert_allclose(round_trip(w), w, rtol=1e-9, atol=1e-20)


@jax.jit
def round_trip(w):
    return quat.log(quat.exp(w))


def test_exp_is_mujocos_integration_from_the_identity():
    w = random_vectors(4, 7.0)
    expected = np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
    for q, vector in zip(expected, w, strict=True):
        mujoco.mju_quatIntegrate(q, vector, 1.0)
    np.testing.assert_allclose(jax.jit(quat.exp)(w), expected, atol=1e-12)


def test_log_takes_the_short_way_and_is_blind_to_the_sign():
    q = jnp.asarray(random_quats(5))
    log = jax.jit(quat.log)
    np.testing.assert_allclose(log(q), log(-q), atol=1e-14)
    assert np.linalg.norm(log(q), axis=1).max() <= np.pi + 1e-12
    long_way = jnp.tile(jnp.array([0.0, 0.0, 1.5 * np.pi]), (COUNT, 1))
    np.testing.assert_allclose(
        round_trip(long_way)[0], [0.0, 0.0, -0.5 * np.pi], atol=1e-12
    )


@pytest.mark.parametrize("size", [1e-5, 1.0, np.pi, 4.0, 6.0])
@pytest.mark.parametrize(("kind", "error"), [(np.float64, 1e-12), (np.float32, 3e-6)])
def test_long_log_undoes_exp_up_to_a_whole_turn(size, kind, error):
    w = random_vectors(3, 1.0)
    w = (size * w / np.linalg.norm(w, axis=1, keepdims=True)).astype(kind)
    found = jax.jit(lambda w: quat.long_log(quat.exp(w)))(w)
    np.testing.assert_allclose(found, w, atol=error)


@pytest.mark.parametrize("left", [1e-2, 1e-3, 2e-4, 1e-5, 0.0])
def test_long_log_is_finite_next_to_a_whole_turn(left):
    q = np.float32([np.cos(np.pi - left / 2), 0.0, np.sin(np.pi - left / 2), 0.0])
    found = np.asarray(quat.long_log(q))
    assert np.all(np.isfinite(found))
    if left > 2e-4:
        np.testing.assert_allclose(found, [0.0, 2 * np.pi - left, 0.0], atol=1e-4)


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-4, 1.1e-4, 0.5])
def test_exp_and_log_have_finite_gradients_that_undo_each_other(size):
    w = jnp.asarray(size * np.array([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(round_trip))(w), np.eye(3), atol=1e-7)


def test_slerp_goes_from_one_end_to_the_other_at_constant_speed():
    a, b = random_quats(6), random_quats(7)
    slerp = jax.jit(quat.slerp)
    angle = jax.jit(
        lambda a, b: jnp.linalg.norm(quat.log(quat.mul(quat.inv(a), b)), axis=-1)
    )
    whole = angle(a, b)
    for t in (0.0, 0.25, 0.5, 1.0):
        part = angle(a, slerp(a, b, jnp.full((COUNT, 1), t)))
        np.testing.assert_allclose(part, t * whole, atol=1e-7)


def test_heading_is_the_direction_of_x_on_the_ground():
    q = random_quats(8)
    heading = jax.jit(quat.heading)(q)
    np.testing.assert_allclose(heading[:, 1:3], 0.0)
    rotate = jax.jit(quat.rotate)
    x = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (COUNT, 1))
    forward, headed = np.array(rotate(q, x)), np.asarray(rotate(heading, x))
    forward[:, 2] = 0.0
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    np.testing.assert_allclose(headed, forward, atol=1e-12)


def test_heading_of_a_vertical_axis_is_the_identity():
    up = jnp.array([[np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]])
    np.testing.assert_allclose(jax.jit(quat.heading)(up), [[1.0, 0.0, 0.0, 0.0]])


@pytest.mark.parametrize("model", [CHARACTER, MIXED], ids=["character", "mixed"])
def test_coordinates_know_every_quaternion(model):
    coords = quat.Coordinates.of(model)
    balls = np.isin(model.jnt_type, (0, 1)).sum()
    assert coords.quat_qpos.shape == (balls, 4)
    assert coords.quat_dof.shape == (balls, 3)
    np.testing.assert_array_equal(
        np.sort(np.r_[coords.scalar_qpos, coords.quat_qpos.ravel()]),
        np.arange(model.nq),
    )
    np.testing.assert_array_equal(
        np.sort(np.r_[coords.scalar_dof, coords.quat_dof.ravel()]), np.arange(model.nv)
    )


@functools.cache
def algebra(model: mujoco.MjModel):
    """The joint-wise operations of a model, compiled once."""
    coords = quat.Coordinates.of(model)
    operations = (quat.oplus, quat.ominus, quat.exp_map, quat.log_map)
    return [jax.jit(functools.partial(operation, coords)) for operation in operations]


@pytest.mark.parametrize("pairs", [1, 3, 12])
def test_parts_of_coordinates_join_to_what_they_were(pairs):
    """Hinges and ball joints by turns: few runs of neighbours, and many."""
    kinds = ("hinge", "ball") * pairs
    inside = "".join(f"<body><joint type='{k}'/><geom size='.1'/>" for k in kinds)
    xml = f"<mujoco><worldbody>{inside}{'</body>' * 2 * pairs}</worldbody></mujoco>"
    coords = quat.Coordinates.of(mujoco.MjModel.from_xml_string(xml))
    q, v = jnp.arange(5.0 * pairs), jnp.arange(4.0 * pairs)
    scalars, quats = coords.split_q(q)
    np.testing.assert_array_equal(scalars, q[::5])
    np.testing.assert_array_equal(quats, q.reshape(pairs, 5)[:, 1:])
    np.testing.assert_array_equal(coords.join_q(scalars, quats), q)
    np.testing.assert_array_equal(coords.join_v(*coords.split_v(v)), v)


@pytest.mark.parametrize("model", [CHARACTER, MIXED], ids=["character", "mixed"])
def test_ominus_undoes_oplus_and_oplus_undoes_ominus(model):
    oplus, ominus, _, _ = algebra(model)
    q, u = random_q(model, 9), random_q(model, 10)
    np.testing.assert_allclose(ominus(oplus(q, u), u), q, atol=1e-12)
    np.testing.assert_allclose(oplus(ominus(q, u), u), q, atol=1e-12)


def test_displacement_composes_on_the_right_and_not_on_the_left():
    oplus, _, _, _ = algebra(CHARACTER)
    q, u = random_q(CHARACTER, 11), random_q(CHARACTER, 12)
    joint = slice(7, 11)
    right = row_by_row(mujoco.mju_mulQuat, 4, q[:, joint], u[:, joint])
    left = row_by_row(mujoco.mju_mulQuat, 4, u[:, joint], q[:, joint])
    result = oplus(q, u)[:, joint]
    np.testing.assert_allclose(result, right, atol=1e-12)
    assert np.abs(result - left).max() > 0.5


@pytest.mark.parametrize("model", [CHARACTER, MIXED], ids=["character", "mixed"])
def test_oplus_of_exp_is_mujocos_integration(model):
    oplus, _, exp_map, log_map = algebra(model)
    q = random_q(model, 13)
    v = np.random.default_rng(14).uniform(-1.5, 1.5, (COUNT, model.nv))
    expected = q.copy()
    for row, tangent in zip(expected, v, strict=True):
        mujoco.mj_integratePos(model, row, tangent, 1.0)
    np.testing.assert_allclose(oplus(q, exp_map(v)), expected, atol=1e-12)
    np.testing.assert_allclose(log_map(exp_map(v)), v, atol=1e-12)


@pytest.mark.parametrize("model", [CHARACTER, MIXED], ids=["character", "mixed"])
def test_integration_equals_mujocos_and_keeps_quaternions_unit(model):
    coords = quat.Coordinates.of(model)
    integrate = jax.jit(functools.partial(quat.integrate, coords))
    q = random_q(model, 15)
    v = np.random.default_rng(16).normal(0.0, 20.0, (COUNT, model.nv))
    expected = q.copy()
    for row, tangent in zip(expected, v, strict=True):
        mujoco.mj_integratePos(model, row, tangent, 0.004)
    moved = np.asarray(integrate(q, v, 0.004))
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    norms = np.linalg.norm(moved[:, coords.quat_qpos], axis=-1)
    np.testing.assert_allclose(norms, 1.0, atol=1e-12)


def test_identity_displaces_nothing():
    oplus, ominus, _, log_map = algebra(MIXED)
    q = random_q(MIXED, 17)
    u = np.tile(quat.identity(quat.Coordinates.of(MIXED)), (COUNT, 1)).astype(float)
    np.testing.assert_array_equal(oplus(q, u), q)
    np.testing.assert_array_equal(ominus(q, u), q)
    np.testing.assert_array_equal(log_map(u), 0.0)
