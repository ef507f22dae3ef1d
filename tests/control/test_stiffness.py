"""stiffness.py: Eq. (4) and (7) on mechanisms one can work out by hand."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from dcc_jax.character import load_character
from dcc_jax.control import stiffness as st

# Two links of 0.3 and 0.4 m in the plane z = 0, along x at rest.
PLANAR = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body name="upper">
  <joint axis="0 0 1"/><geom size=".05" pos=".15 0 0"/>
  <body name="lower" pos=".3 0 0">
    <joint axis="0 0 1"/><geom size=".05" pos=".2 0 0"/>
  </body></body></worldbody></mujoco>""")
GANTRY = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body name="tool">
  <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
  <joint type="slide" axis="0 0 1"/><geom size=".05"/>
</body></worldbody></mujoco>""")
CHARACTER = load_character()
HUMAN = CHARACTER.spec().compile()


def posed_human(seed: int) -> np.ndarray:
    q = HUMAN.qpos0.copy()
    tangent = np.random.default_rng(seed).normal(0.0, 0.5, HUMAN.nv)
    mujoco.mj_integratePos(HUMAN, q, tangent, 1.0)
    return q


def test_stiffness_of_a_planar_arm_by_hand():
    K = st.stiffness(PLANAR, [0.0, math.pi / 2], "lower", (0.4, 0, 0), kp=200.0)
    # The tip is at (0.3, 0.4): J = [[-0.4, -0.4], [0.3, 0]].
    JJ = np.array([[0.32, -0.12], [-0.12, 0.09]])
    np.testing.assert_allclose(K[:2, :2], 200.0 * np.linalg.inv(JJ), rtol=1e-6)
    np.testing.assert_allclose(K[2], [0.0, 0.0, st.STIFFNESS_LIMIT], atol=1e-6)


def test_stiffness_of_a_gantry_is_its_gains():
    K = st.stiffness(GANTRY, [0.1, 0.2, 0.3], "tool", kp=[100.0, 200.0, 300.0])
    np.testing.assert_allclose(K, np.diag([100.0, 200.0, 300.0]), rtol=1e-12)


def test_default_gain_gives_L():
    q = posed_human(0)
    L = st.stiffness(HUMAN, q, "left_hand")
    np.testing.assert_allclose(
        st.stiffness(HUMAN, q, "left_hand", kp=300.0), 300.0 * L, rtol=1e-9
    )


def test_equal_gains_by_joint_equal_one_gain():
    q = posed_human(1)
    one = st.stiffness(HUMAN, q, "head", (0.0, 0.1, 0.1), kp=400.0)
    each = st.stiffness(HUMAN, q, "head", (0.0, 0.1, 0.1), kp=np.full(HUMAN.nv, 400.0))
    np.testing.assert_allclose(one, each, rtol=1e-12)


def test_stiffness_is_the_inverse_of_what_the_body_yields():
    q, point = posed_human(2), np.array([0.01, 0.12, 0.0])
    K = st.stiffness(HUMAN, q, "left_hand", point, kp=CHARACTER.kp)
    for force in np.eye(3):
        joint_torque = _transposed_jacobian(q, "left_hand", point) @ force
        joint_torque[:6] = 0.0
        gains = np.where(CHARACTER.kp > 0.0, CHARACTER.kp, 1.0)
        ends = []
        # Both ways: the curvature of the hand's path cancels in the difference.
        for step in (0.5e-3, -0.5e-3):
            moved = q.copy()
            mujoco.mj_integratePos(HUMAN, moved, joint_torque / gains, step)
            ends.append(_place(moved, "left_hand", point))
        yielded = ends[0] - ends[1]
        np.testing.assert_allclose(K @ yielded, 1e-3 * force, atol=1e-8)


def _place(q: np.ndarray, body: str, point: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(HUMAN)
    data.qpos[:] = q
    mujoco.mj_kinematics(HUMAN, data)
    return data.body(body).xpos + data.body(body).xmat.reshape(3, 3) @ point


def _transposed_jacobian(q: np.ndarray, body: str, point: np.ndarray) -> np.ndarray:
    """By central differences of the forward kinematics, [nv, 3]."""
    rows = []
    for tangent in 1e-6 * np.eye(HUMAN.nv):
        ends = []
        for sign in (1.0, -1.0):
            moved = q.copy()
            mujoco.mj_integratePos(HUMAN, moved, tangent, sign)
            ends.append(_place(moved, body, point))
        rows.append((ends[0] - ends[1]) / 2e-6)
    return np.array(rows)


def test_root_counts_only_when_asked():
    q = posed_human(3)
    without = st.stiffness(HUMAN, q, "left_hand", kp=300.0)
    with_root = st.stiffness(HUMAN, q, "left_hand", kp=300.0, root=True)
    assert np.linalg.eigvalsh(without - with_root).min() > 0.0
    moved = q.copy()
    moved[:3] += (1.0, 2.0, 3.0)
    np.testing.assert_allclose(
        st.stiffness(HUMAN, moved, "left_hand", kp=300.0), without, rtol=1e-8
    )


def test_straight_arm_is_stiff_along_itself_and_bent_arm_yields():
    straight, bent = HUMAN.qpos0.copy(), HUMAN.qpos0.copy()
    elbow = HUMAN.joint("left_elbow").qposadr[0]
    bent[elbow : elbow + 4] = [math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)]
    locked_spine = np.where(np.arange(HUMAN.nv) < 9, np.inf, 300.0)
    along = [
        st.stiffness(HUMAN, q, "left_hand", (0, 0.17, 0), locked_spine)[1, 1]
        for q in (straight, bent)
    ]
    assert along[0] == pytest.approx(st.STIFFNESS_LIMIT)
    assert along[1] < 1e4


def test_modulated_stiffness_has_determinant_one_minus_alpha_cubed():
    K = st.stiffness(HUMAN, posed_human(4), "right_hand", kp=300.0)
    for alpha in (0.0, 0.04, 0.08, 0.16, 0.5, 1.0):
        K_hat = st.modulated_stiffness(K, alpha)
        np.testing.assert_allclose(K_hat, (1.0 - alpha) * K)
        ratio = st.determinant(K_hat) / st.determinant(K)
        assert ratio == pytest.approx((1.0 - alpha) ** 3, abs=1e-12)


def test_ellipsoid_rebuilds_its_stiffness():
    K = st.stiffness(HUMAN, posed_human(5), "head", kp=300.0)
    axes, radii = st.ellipsoid(K)
    assert np.all(np.diff(radii) > 0.0)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes * radii @ axes.T, K, rtol=1e-9, atol=1e-6)


def test_deflection_under_a_force_by_hand():
    K = np.diag([100.0, 200.0, 400.0])
    np.testing.assert_allclose(st.deflection(K, (1.0, 1.0, 1.0)), [0.01, 0.005, 0.0025])
    np.testing.assert_allclose(st.deflection(K, (1.0, 0, 0), alpha=0.5), [0.02, 0, 0])


EMPTY = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body name="rock"><geom size=".1"/></body></worldbody></mujoco>'
)
REST = HUMAN.qpos0
K = np.diag([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: st.stiffness(HUMAN, REST, "tail"),
            "body must be one of.*pelvis.*tail",
        ),
        (lambda: st.stiffness(HUMAN, REST[:-1], "head"), r"qpos.*\(55,\).*\(54,\)"),
        (lambda: st.stiffness(HUMAN, REST * np.nan, "head"), "qpos must be finite"),
        (lambda: st.stiffness(HUMAN, "abc", "head"), "qpos must be 55 numbers"),
        (lambda: st.stiffness(EMPTY, [], "rock"), "no joints"),
        (lambda: st.stiffness(HUMAN, REST, "pelvis"), "moves body 'pelvis'"),
        (lambda: st.stiffness(HUMAN, REST, "head", (0, 1)), "point must have shape"),
        (lambda: st.stiffness(HUMAN, REST, "head", kp=0.0), "kp must be positive"),
        (lambda: st.stiffness(HUMAN, REST, "head", kp=[1.0, 2.0]), r"kp.*\(42,\)"),
        (lambda: st.stiffness(HUMAN, REST, "head", kp=math.nan), "kp must be positive"),
        (lambda: st.modulated_stiffness(K, 1.1), r"alpha must be in \[0, 1\], got 1.1"),
        (lambda: st.modulated_stiffness(K, -0.1), "alpha"),
        (lambda: st.modulated_stiffness(K, math.nan), "alpha"),
        (lambda: st.deflection(K, (math.inf, 0, 0)), "force must be finite, got inf"),
        (lambda: st.deflection(K, (1, 0, 0), alpha=1.0), "alpha must be below 1"),
        (lambda: st.determinant(np.eye(2)), "K must have shape"),
        (lambda: st.ellipsoid(K + np.triu(np.ones((3, 3)))), "K must be symmetric"),
        (lambda: st.ellipsoid(K * np.nan), "K must be finite"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
