"""character.py: what Sec. 5.1 says of the character, and the scenes made of it."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from dcc_jax.character import (
    BODIES,
    JOINTS,
    add_contact,
    asset_path,
    compose_scene,
    load_character,
    sole_names,
)

CHARACTER = load_character()
MODEL = CHARACTER.spec().compile()


def at_rest() -> mujoco.MjData:
    data = mujoco.MjData(MODEL)
    mujoco.mj_forward(MODEL, data)
    return data


def lowest_and_highest_point(data: mujoco.MjData) -> tuple[float, float]:
    """Of all geoms, m; a box and a capsule by their corners and ends."""
    lows, highs = [], []
    for geom in range(MODEL.ngeom):
        size, z = MODEL.geom_size[geom], data.geom_xpos[geom, 2]
        rows = np.abs(data.geom_xmat[geom].reshape(3, 3)[2])
        reach = {
            mujoco.mjtGeom.mjGEOM_SPHERE: size[0],
            mujoco.mjtGeom.mjGEOM_CAPSULE: size[0] + rows[2] * size[1],
            mujoco.mjtGeom.mjGEOM_BOX: rows @ size,
        }[mujoco.mjtGeom(MODEL.geom_type[geom])]
        lows.append(z - reach)
        highs.append(z + reach)
    return min(lows), max(highs)


def test_character_is_163_cm_tall_and_stands_on_the_floor():
    low, high = lowest_and_highest_point(at_rest())
    assert low == pytest.approx(0.0, abs=1e-9)
    assert high == pytest.approx(1.63, abs=0.005)
    assert at_rest().qpos[2] == CHARACTER.stand_height


def test_character_weighs_65_kg():
    assert MODEL.body_mass.sum() == pytest.approx(65.0, abs=1e-6)


def test_character_has_a_free_root_12_ball_joints_and_2_welded_hands():
    kinds = [mujoco.mjtJoint(kind).name for kind in MODEL.jnt_type]
    assert kinds == ["mjJNT_FREE"] + 12 * ["mjJNT_BALL"]
    names = tuple(MODEL.body(i).name for i in range(1, MODEL.nbody))
    assert names == BODIES == CHARACTER.body_names
    welded = [name for name in names if MODEL.body(name).jntnum[0] == 0]
    assert welded == ["left_hand", "right_hand"]
    assert (MODEL.nq, MODEL.nv) == (CHARACTER.nq, CHARACTER.nv) == (55, 42)


def test_tables_list_the_joints_in_mujocos_order():
    names = tuple(MODEL.joint(i).name for i in range(1, MODEL.njnt))
    assert names == CHARACTER.joint_names
    assert names == tuple(joint.name for joint in JOINTS)


def test_gains_are_the_papers():
    joints = CHARACTER.kp[6:]
    assert (joints.min(), joints.max()) == (300.0, 500.0)
    np.testing.assert_allclose(CHARACTER.kv, 2.0 * np.sqrt(CHARACTER.kp))
    np.testing.assert_array_equal(CHARACTER.kp[:6], 0.0)
    assert np.all(np.isinf(CHARACTER.torque_limit[:6]))


def test_columns_favour_hips_and_shoulders_and_omit_root_turn_and_height():
    np.testing.assert_array_equal(CHARACTER.column_weight[:6], [1, 1, 0, 0, 0, 0])
    by_joint = CHARACTER.column_weight[6:].reshape(12, 3)
    for name, weights in zip(CHARACTER.joint_names, by_joint, strict=True):
        expected = 2.0 if name.endswith(("hip", "shoulder")) else 1.0
        np.testing.assert_array_equal(weights, expected)


def test_left_and_right_mirror_each_other():
    data = at_rest()
    for name in BODIES:
        if not name.startswith("left_"):
            continue
        left, right = data.body(name), data.body(name.replace("left_", "right_"))
        np.testing.assert_allclose(left.xipos * [1, -1, 1], right.xipos, atol=1e-12)
        twin = MODEL.body(name.replace("left_", "right_"))
        np.testing.assert_allclose(MODEL.body(name).mass, twin.mass)
        np.testing.assert_allclose(MODEL.body(name).inertia, twin.inertia, rtol=1e-9)


def test_joint_ranges_hold_the_zero_pose_and_mirror():
    assert np.all(CHARACTER.lower < 0.0) and np.all(CHARACTER.upper > 0.0)
    for i, name in enumerate(CHARACTER.joint_names):
        if name.startswith("left_"):
            j = CHARACTER.joint_names.index(name.replace("left_", "right_"))
            mirrored = CHARACTER.upper[j] * [-1, 1, -1]
            lower = np.where([True, False, True], mirrored, CHARACTER.lower[j])
            np.testing.assert_allclose(CHARACTER.lower[i], lower)


@pytest.mark.parametrize("mass", [36.0, 85.0])
def test_mass_variants_scale_masses_inertias_and_gains_alike(mass):
    variant, scale = load_character(mass), mass / 65.0
    model = variant.spec().compile()
    assert model.body_mass.sum() == pytest.approx(mass)
    np.testing.assert_allclose(model.body_mass, scale * MODEL.body_mass)
    np.testing.assert_allclose(model.body_inertia, scale * MODEL.body_inertia)
    for table in ("kp", "kv", "torque_limit"):
        np.testing.assert_allclose(
            getattr(variant, table), scale * getattr(CHARACTER, table)
        )
    np.testing.assert_array_equal(variant.column_weight, CHARACTER.column_weight)


@pytest.mark.parametrize("mass", [0.0, 19.0, 151.0, math.nan, -65.0])
def test_an_absurd_mass_is_refused(mass):
    with pytest.raises(ValueError, match="mass must be in"):
        load_character(mass)


def test_scene_touches_the_floor_with_its_eight_soles_alone():
    model = compose_scene(CHARACTER, timestep=1.0 / 300.0)
    assert model.opt.timestep == pytest.approx(1.0 / 300.0)
    names = {model.geom(i).name for i in model.pair_geom1} | {
        model.geom(i).name for i in model.pair_geom2
    }
    assert names == {"floor", *sole_names(CHARACTER.spec())}
    assert model.npair == 8
    data = mujoco.MjData(model)
    data.qpos[2] -= 1e-3
    mujoco.mj_forward(model, data)
    assert data.ncon == 8


def test_a_tilted_foot_keeps_its_contacts_where_its_soles_are():
    model = compose_scene(CHARACTER)
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.02
    mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array([1.0, 0.0, 0.0]), 0.05)
    mujoco.mj_forward(model, data)
    below = sum(
        data.geom(name).xpos[2] < model.geom(name).size[0]
        for name in sole_names(CHARACTER.spec())
    )
    assert data.ncon == below > 0


def test_scene_can_be_extended_and_left_without_a_floor():
    def wall(spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(
            name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 1, 1], pos=[1, 0, 1]
        )
        add_contact(spec, "wall", "chest", friction=0.5)

    model = compose_scene(CHARACTER, floor=False, extend=wall)
    assert model.npair == 1
    np.testing.assert_allclose(model.pair_friction[0, :2], 0.5)
    with pytest.raises(KeyError, match="floor"):
        model.geom("floor")


def test_a_bad_timestep_is_refused():
    with pytest.raises(ValueError, match="timestep must be positive, got 0"):
        compose_scene(CHARACTER, timestep=0.0)


def test_a_missing_asset_is_named():
    with pytest.raises(FileNotFoundError, match=r"nothing\.xml"):
        asset_path("nothing.xml")
