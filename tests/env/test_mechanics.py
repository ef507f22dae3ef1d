"""Energy, soles and joint ranges against C MuJoCo."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import quat
from dcc_jax.character import Character, compose_scene, load_character
from dcc_jax.env import mechanics
from dcc_jax.env.mechanics import Mechanics


@pytest.fixture(scope="module", params=[65.0, 85.0])
def heavy(request) -> Character:
    return load_character(request.param)


def _random_state(model: mujoco.MjModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, qd = model.qpos0.copy(), rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, q, rng.normal(size=model.nv), 1.0)
    return q, qd


def test_energy_is_that_of_c_mujoco(heavy):
    model = compose_scene(heavy, floor=False)
    data = mujoco.MjData(model)
    tables = Mechanics.of(heavy)
    ours = jax.jit(lambda q, qd: mechanics.energy(tables, q, qd))
    for seed in range(3):
        data.qpos[:], data.qvel[:] = _random_state(model, seed)
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        kinetic, potential = ours(jnp.array(data.qpos), jnp.array(data.qvel))
        assert data.energy[1] > 10.0
        np.testing.assert_allclose(
            [potential, kinetic], data.energy, rtol=1e-4, atol=1e-2
        )


def test_sole_points_are_below_the_geoms_of_c_mujoco(character):
    model = compose_scene(character, floor=False)
    data = mujoco.MjData(model)
    data.qpos[:], _ = _random_state(model, 7)
    mujoco.mj_kinematics(model, data)
    names = [model.geom(i).name for i in range(model.ngeom)]
    soles = [i for i, name in enumerate(names) if "_sole_" in name]
    assert len(soles) == 8
    lowest = data.geom_xpos[soles] - [0.0, 0.0, 0.02]
    points = mechanics.sole_points(Mechanics.of(character), jnp.array(data.qpos))
    np.testing.assert_allclose(points, lowest, atol=1e-5)


def test_only_soles_that_stood_and_stand_slip():
    before = np.zeros((8, 3))
    now = before + np.array([0.03, 0.04, 0.0])
    before[4:, 2] = 0.1  # comes down in between
    now[:2, 2] = 0.1  # lifts
    distance, stands = mechanics.slip(
        jnp.array(now), jnp.array(before), jnp.zeros(()), jnp.zeros(())
    )
    assert stands
    assert float(distance) == pytest.approx(0.05)
    distance, stands = mechanics.slip(
        jnp.array(now), jnp.array(before), jnp.array(-1.0), jnp.array(-1.0)
    )
    assert not stands and float(distance) == 0.0


def test_sliding_is_the_speed_of_the_soles_that_stand_and_of_no_other(character):
    tables = Mechanics.of(character)
    stand = jnp.zeros(55).at[3::4].set(1.0)
    lowest = jnp.min(mechanics.sole_points(tables, stand)[:, 2])
    stand = stand.at[2].add(-lowest)

    def sliding(now, before):
        return np.asarray(mechanics.sliding(tables, now, before))

    before = stand.at[:2].add(jnp.array([-0.003, -0.004]))
    np.testing.assert_allclose(sliding(stand, before), 0.005 * 30.0, rtol=1e-3)
    assert np.all(sliding(stand, stand) < 1e-4)
    # Half of it is counted where both moments are TOUCH sqrt(log(2) / 2) too high.
    up = mechanics.TOUCH * np.sqrt(np.log(2.0) / 2.0)
    half = sliding(stand.at[2].add(up), before.at[2].add(up))
    np.testing.assert_allclose(half, 0.075, rtol=1e-3)
    lifted = sliding(stand.at[2].add(0.02), before)
    assert np.all(lifted < 1e-6)
    # The right hip bends: that foot is in the air, and the left one slides.
    hip = 7 + 4 * character.joint_names.index("right_hip")
    bent = quat.exp(jnp.array([0.0, -0.5, 0.0]))
    raised = [q.at[hip : hip + 4].set(bent) for q in (stand, before)]
    left, right = sliding(*raised)
    assert left == pytest.approx(0.15, rel=1e-3) and right < 0.02


def test_joint_outside_its_range_is_seen_by_as_much(character):
    tables = Mechanics.of(character)
    knee = character.joint_names.index("left_knee")
    q = np.zeros(55)
    q[3::4] = 1.0
    assert not np.any(mechanics.range_excess(tables, jnp.array(q)))
    angle = character.upper[knee, 1] + 0.2
    start = 7 + 4 * knee
    q[start : start + 4] = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
    excess = np.array(mechanics.range_excess(tables, jnp.array(q)))
    assert excess[knee, 1] == pytest.approx(0.2, abs=1e-5)
    assert np.count_nonzero(excess) == 1
