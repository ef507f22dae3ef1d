"""The compiled kernel of kinematics and contacts against MJX and C MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import native, physics
from dcc_jax.character import Character, compose_scene
from dcc_jax.physics import kinematics_kernel
from dcc_jax.physics import scene as scenes
from dcc_jax.physics.kinematics_kernel import CONTACT_FIELDS, FIELDS, PAIRS, Tree
from dcc_jax.physics.quiet_mjx import mjx

pytestmark = pytest.mark.skipif(
    not native.available(), reason="no C++ compiler: physics runs in JAX"
)
BATCH = 400
TURN = "quat='.8 .3 -.4 .2'"
MODEL = mujoco.MjModel.from_xml_string(
    f"""<mujoco><option gravity='.3 -.2 -9.81'/><worldbody>
    <geom type='plane' size='1 1 1' pos='0 0 -.1' quat='.99 .1 0 0'/>
    <site name='still' pos='.1 .2 .3' {TURN}/>
    <body pos='0 0 .2' {TURN}><freejoint/>
      <geom type='capsule' size='.1 .2' pos='.05 0 0' {TURN}/><site pos='.1 0 0'/>
      <body pos='.2 .1 0' {TURN}><joint type='ball' pos='.1 .05 0'/>
        <geom type='box' size='.2 .1 .15' mass='2'/>
        <body pos='.3 0 0'><joint axis='.6 .8 0' pos='0 .1 0' ref='.3'/>
          <joint type='slide' axis='0 .6 .8' ref='.05'/><geom size='.1'/>
        </body></body>
      <body pos='-.3 0 0'><geom size='.12' density='500'/></body></body>
    <body pos='.3 0 .1'><joint type='slide' axis='1 0 0'/><joint axis='0 0 1'/>
      <geom type='box' size='.15 .2 .1'/></body>
    <body pos='0 .4 .1'><freejoint/><geom size='.15'/></body>
    <body pos='0 -.4 .1'><freejoint/><geom type='capsule' size='.12 .15'/></body>
    <body mocap='true' pos='-.5 0 .2'><geom size='.1'/><geom type='box' pos='.1 0 0'
      size='.1 .1 .1' contype='0' conaffinity='0'/></body>
    </worldbody></mujoco>"""
)
# Boxes with boxes or the floor are not among what the kernel collides.
BOXES = MODEL.geom_type == mujoco.mjtGeom.mjGEOM_BOX
MODEL.geom_contype[BOXES], MODEL.geom_conaffinity[BOXES] = 2, 4
ROUND = ~BOXES & (MODEL.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
MODEL.geom_contype[ROUND], MODEL.geom_conaffinity[ROUND] = 5, 3
DEVICE = mjx.put_model(MODEL)
TEMPLATE = mjx.make_data(DEVICE)
CONTACTS = scenes._contacts(DEVICE, TEMPLATE)
TREE = Tree.of(MODEL, CONTACTS)
# Poses of geoms are for MJX, where it collides.
WHOLE = replace(
    TREE, shapes={name: (getattr(MODEL, n), *each) for name, n, each in FIELDS}
)
STAGES = mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne, mjx.collision


@pytest.fixture(scope="module")
def states() -> list[jax.Array]:
    """Coordinates, velocities and poses of mocap bodies, quaternions of any length."""
    rng = np.random.default_rng(0)
    shapes = (MODEL.nq,), (MODEL.nv,), (MODEL.nmocap, 3), (MODEL.nmocap, 4)
    qpos, qvel, pos, turn = (rng.normal(size=(BATCH, *shape)) for shape in shapes)
    given = MODEL.qpos0 + 0.3 * qpos, 3.0 * qvel, 0.3 * pos, turn
    return [jnp.asarray(x, jnp.float32) for x in given]


def given_data(qpos, qvel, mocap_pos, mocap_quat) -> mjx.Data:
    given = {"mocap_pos": mocap_pos, "mocap_quat": mocap_quat}
    return TEMPLATE.replace(qpos=qpos, qvel=qvel, **given)


def kernel(*state) -> dict[str, jax.Array]:
    return parts(kinematics_kernel.kinematics(WHOLE, given_data(*state)))


def in_mjx(*state) -> dict[str, jax.Array]:
    data = given_data(*state)
    for stage in STAGES:
        data = stage(DEVICE, data)
    return parts(data)


def parts(data: mjx.Data) -> dict[str, jax.Array]:
    fields = [name for name, *_ in FIELDS if name != "_impl.crb"]
    contacts = {name: getattr(data._impl.contact, name) for name, _ in CONTACT_FIELDS}
    return {x: getattr(data, x) for x in fields} | {"crb": data._impl.crb} | contacts


@pytest.fixture(scope="module")
def both(states):
    made = jax.jit(jax.vmap(kernel))(*states), jax.jit(jax.vmap(in_mjx))(*states)
    return [jax.tree.map(np.asarray, x) for x in made]


def test_everything_but_contacts_is_what_mjx_computes(both):
    ours, theirs = both
    for name in ours.keys() - {name for name, _ in CONTACT_FIELDS}:
        scale = np.abs(theirs[name]).max()
        np.testing.assert_allclose(ours[name], theirs[name], atol=3e-6 * scale)


def test_poses_of_geoms_are_left_out_where_the_kernel_collides():
    assert WHOLE.shapes.keys() - TREE.shapes.keys() == {"geom_xpos", "geom_xmat"}
    data = jax.eval_shape(lambda: kinematics_kernel.kinematics(TREE, TEMPLATE))
    assert data.geom_xpos.shape == (MODEL.ngeom, 3)


def test_the_fields_are_c_mujocos(states):
    """An oracle of its own: what MJX has wrong the kernel would have wrong too."""
    ours, data = jax.jit(kernel)(*[x[0] for x in states]), mujoco.MjData(MODEL)
    fields = data.qpos, data.qvel, data.mocap_pos, data.mocap_quat
    for field, value in zip(fields, states, strict=True):
        field[:] = value[0]
    mujoco.mj_forward(MODEL, data)
    names = [n for n, *_ in FIELDS if n not in ("_impl.crb", "xmat")]
    for name in names:
        expected = getattr(data, name).reshape(ours[name].shape)
        np.testing.assert_allclose(ours[name], expected, atol=2e-4, err_msg=name)


def kinds() -> np.ndarray:
    """[C] the types of the geoms of each contact slot."""
    kind = mujoco.mjtGeom
    pairs = [tuple(map(kind, MODEL.geom_type[pair])) for pair in CONTACTS.geom]
    return np.array([PAIRS.index(pair) for pair in pairs])


def test_the_kernel_collides_every_scene_that_ships_and_this_one(scene):
    assert TREE.collides and scene.tree.collides


@pytest.mark.parametrize("kind", range(len(PAIRS)))
def test_contacts_of_every_kind_are_what_mjx_finds(both, kind):
    ours, theirs = both
    slots = kinds() == kind
    touching = theirs["dist"][:, slots] < 0.0
    assert touching.sum() > 20
    assert (~touching).sum() > 20
    np.testing.assert_array_equal(ours["dist"][:, slots] < 0.0, touching)
    for name, _ in CONTACT_FIELDS:
        found, expected = ours[name][:, slots], theirs[name][:, slots]
        np.testing.assert_allclose(found[touching], expected[touching], atol=2e-4)
        assert np.isfinite(found).all()


def test_an_environment_is_the_same_to_the_bit_wherever_it_is(states, both):
    ours, _ = both
    for first in (3, BATCH - 1):
        again = jax.vmap(kernel)(*[x[first:] for x in states])
        for name, value in again.items():
            np.testing.assert_array_equal(value, ours[name][first:])


def test_what_is_not_a_number_stays_in_its_environment(states, both):
    ours, _ = both
    spoiled = jax.vmap(kernel)(states[0].at[4].set(jnp.nan), *states[1:])
    others = np.arange(BATCH) != 4
    for name, value in spoiled.items():
        np.testing.assert_array_equal(value[others], ours[name][others])
    assert np.isnan(spoiled["qfrc_bias"][4]).all()


def test_geoms_that_the_kernel_does_not_know_are_left_to_mjx(character: Character):
    def crate(spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name="crate", pos=[1.0, 0.0, 0.09])
        body.add_freejoint()
        box = mujoco.mjtGeom.mjGEOM_BOX
        body.add_geom(name="crate", type=box, size=[0.1, 0.1, 0.1])
        spec.add_pair(geomname1="floor", geomname2="crate", condim=3)

    scene = physics.make_scene(compose_scene(character, extend=crate), character)
    assert not scene.tree.collides
    state = physics.initial_state(
        scene, jnp.asarray(scene.model.qpos0, jnp.float32), jnp.zeros(scene.model.nv)
    )
    found = jax.jit(lambda: physics.kinematics(scene, state).data._impl.contact.dist)()
    assert found.shape == (len(scene.contact_bodies),)
    crate_id = scene.body("crate")
    of_crate = (scene.contact_bodies == crate_id).any(axis=1)
    np.testing.assert_allclose(found[of_crate].min(), -0.01, atol=1e-5)


def test_in_a_fluid_physics_is_mjxs(character: Character):
    model = compose_scene(character)
    model.opt.density = 1.2
    scene = physics.make_scene(model, character)
    zero = jnp.zeros(model.nv)
    state = physics.initial_state(scene, jnp.asarray(model.qpos0, jnp.float32), zero)
    program = jax.make_jaxpr(lambda: physics.kinematics(scene, state))()
    assert "ffi_call" not in str(program)


def test_a_body_that_is_turned_by_very_little_is_turned():
    """Its real part is 1 in single precision."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body quat='1 0 0 1e-4'><freejoint/><geom size='.1'/>
        <body quat='1 0 0 1e-4'><body pos='1 0 0'><geom size='.1'/></body></body>
        </body></worldbody></mujoco>"""
    )
    device = mjx.put_model(model)
    template = mjx.make_data(device)
    tree = Tree.of(model, scenes._contacts(device, template))
    data = jax.jit(lambda: kinematics_kernel.kinematics(tree, template))()
    there = mujoco.MjData(model)
    mujoco.mj_forward(model, there)
    np.testing.assert_allclose(data.xpos, there.xpos, atol=1e-6)
    assert abs(there.xpos[-1, 1]) > 3e-4
