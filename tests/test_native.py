"""The contact solver's compiled kernel against MJX's rows and the solver in JAX."""

from __future__ import annotations

import re
import subprocess

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import native, physics
from dcc_jax.physics import contact_solver, newton_kernel
from dcc_jax.physics import scene as scenes
from dcc_jax.physics.quiet_mjx import mjx
from dcc_jax.physics.sparsity import arrow

ITERATIONS = 8
LIMB = """<body pos='.2 {y} 0'><joint type='ball' damping='1'/><geom size='.1'/>
<body name='tip{y}' pos='.2 0 0'><joint axis='0 1 0' limited='{limited}'
range='-1 1'/><geom size='.1'/></body></body>"""
MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><option><flag eulerdamp='disable'/></option><worldbody>"
    "<geom type='plane' size='1 1 1' friction='.7 .1 .1'/>"
    "<body pos='0 0 .12'><freejoint/><geom size='.1'/>"
    + LIMB.format(y=0.2, limited="true")
    + LIMB.format(y=-0.2, limited="false")
    + "</body><body name='ball' pos='.2 0 .2'><freejoint/><geom size='.12'/></body>"
    "</worldbody><equality><connect body1='tip-0.2' anchor='0 0 0'/></equality>"
    "</mujoco>"
)
MODEL.dof_armature[:] = np.linspace(0.01, 0.02, MODEL.nv)
DEVICE = mjx.put_model(MODEL)
TEMPLATE = mjx.make_data(DEVICE)
CONTACTS = scenes._contacts(DEVICE, TEMPLATE)
SHAPE = arrow(MODEL, scenes._row_pattern(MODEL, MODEL.geom_bodyid[CONTACTS.geom]))
LAYOUT = newton_kernel.Layout.of(MODEL, CONTACTS, TEMPLATE._impl.ne)
needs_kernel = pytest.mark.skipif(
    not native.available(), reason="no C++ compiler: the solver runs in JAX"
)


BATCH = 40


@pytest.fixture(scope="module")
def states() -> list[jax.Array]:
    """Coordinates, velocities, smooth forces and start of `BATCH` environments."""
    rng = np.random.default_rng(0)
    vector = (BATCH, MODEL.nv)
    qpos = MODEL.qpos0 + 0.05 * rng.normal(size=(BATCH, MODEL.nq))
    qpos[:, [0, 17]] += 30.0  # far from the origin
    given = qpos, rng.normal(size=vector), 5.0 * rng.normal(size=vector)
    return [jnp.asarray(x, jnp.float32) for x in (*given, rng.normal(size=vector))]


@pytest.fixture(scope="module")
def both(states):
    """What the kernel is given, and what the solver in JAX finds: qacc, force."""

    def one(qpos, qvel, smooth, start):
        data = TEMPLATE.replace(qpos=qpos, qvel=qvel)
        for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.collision):
            data = stage(DEVICE, data)
        given = newton_kernel.problem(DEVICE, data, smooth, start)
        data = mjx.make_constraint(DEVICE, data)
        rows = contact_solver.Rows(
            data._impl.efc_J, data._impl.efc_D, data._impl.efc_aref, LAYOUT.num_equality
        )
        mass = mjx.full_m(DEVICE, data)
        found = contact_solver.newton(SHAPE, mass, smooth, rows, start, ITERATIONS)
        return given, found

    return jax.jit(jax.vmap(one))(*states)


def kernel(given):
    return newton_kernel.newton(SHAPE, LAYOUT, given, ITERATIONS)


@needs_kernel
@pytest.mark.parametrize("batch", [1, 7, BATCH])
def test_kernel_finds_what_the_solver_in_jax_finds(both, batch):
    given, expected = jax.tree.map(lambda x: x[:batch], both)
    for ours, theirs in zip(jax.vmap(kernel)(given), expected, strict=True):
        scale = np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * scale)


def test_rows_of_every_kind_act_in_what_is_compared(both):
    _, (_, force) = both
    given = LAYOUT.num_equality, SHAPE.num_rows - 4 * LAYOUT.num_contacts
    assert given == (3, 4)
    assert (np.abs(force[:, :3]) > 0.0).any(), "equality"
    assert (force[:, 3] > 0.0).any(), "limit"
    edges = force[:, 4:].reshape(BATCH, LAYOUT.num_contacts, 4)
    touching = (edges > 0.0).any(axis=(0, 2))
    first, second = LAYOUT.last.T
    assert touching[(first < 0) | (second < 0)].any(), "contact with the floor"
    trees = LAYOUT.root[LAYOUT.last]
    apart = (first >= 0) & (second >= 0) & (trees[:, 0] != trees[:, 1])
    assert touching[apart].any(), "contact of two trees"


@needs_kernel
def test_an_environment_is_solved_the_same_to_the_bit_wherever_it_is(both):
    given, _ = both
    qacc, force = jax.vmap(kernel)(given)
    for first in (0, 3, 39):
        rest = jax.tree.map(lambda x, first=first: x[first:], given)
        again = jax.vmap(kernel)(rest)
        np.testing.assert_array_equal(again[0], qacc[first:])
        np.testing.assert_array_equal(again[1], force[first:])
    alone = kernel(jax.tree.map(lambda x: x[5], given))
    np.testing.assert_array_equal(alone[0], qacc[5])


@needs_kernel
def test_a_batch_of_batches_is_one_batch(both):
    given, _ = both
    qacc, force = jax.vmap(kernel)(given)
    split = jax.tree.map(lambda x: x.reshape(4, BATCH // 4, *x.shape[1:]), given)
    nested = jax.vmap(jax.vmap(kernel))(split)
    np.testing.assert_array_equal(nested[0].reshape(qacc.shape), qacc)
    np.testing.assert_array_equal(nested[1].reshape(force.shape), force)


@needs_kernel
def test_what_is_not_a_number_stays_in_its_environment(both):
    given, _ = both
    qacc, _ = jax.vmap(kernel)(given)
    spoiled = given.replace(smooth=given.smooth.at[4].set(jnp.nan))
    spoiled, _ = jax.vmap(kernel)(spoiled)
    others = np.arange(BATCH) != 4
    assert np.isnan(spoiled[4]).all()
    np.testing.assert_array_equal(spoiled[others], qacc[others])


@pytest.fixture
def forgetful(monkeypatch):
    """As in a process that has not looked for the kernel yet."""
    native.available.cache_clear()
    yield monkeypatch
    native.available.cache_clear()


def refused():
    raise OSError("no C++ compiler")


def broken():
    raise subprocess.CalledProcessError(1, "c++", stderr="note\nx.cc:1: error: bad\n")


@pytest.mark.parametrize(
    ("failure", "reason"),
    [(refused, "no C++ compiler"), (broken, "x.cc:1: error: bad")],
)
def test_without_a_compiler_one_line_says_that_the_solver_runs_in_jax(
    forgetful, capsys, failure, reason
):
    forgetful.setattr(native, "_compiled", failure)
    assert not native.available()
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "physics in JAX" in said and reason in said


def test_physics_goes_on_in_jax_without_the_kernel(monkeypatch, scene):
    """The choice of `physics.solve`."""

    def program() -> str:
        zero = jnp.zeros(scene.model.nv)
        at = physics.initial_state(scene, jnp.asarray(scene.model.qpos0), zero)
        kin = physics.kinematics(scene, at)
        return str(jax.make_jaxpr(lambda: physics.solve(scene, kin, at, at.qvel))())

    assert ("ffi_call" in program()) == native.available()
    monkeypatch.setattr(native, "available", lambda: False)
    assert "ffi_call" not in program()


def test_the_kernel_can_be_switched_off(forgetful):
    forgetful.setenv(native.SETTING, "0")
    assert not native.available()


def test_source_of_the_kernel_travels_with_the_package():
    assert (native.SOURCES / "newton.cc").is_file()


@pytest.mark.parametrize(
    ("compiler", "why"),
    [("/nowhere/c++ -O1", "CXX=/nowhere/c++ is no program"), ("true", "no library")],
)
def test_a_compiler_that_is_none_is_named(monkeypatch, compiler, why):
    monkeypatch.setenv("CXX", compiler)
    with pytest.raises(OSError, match=re.escape(why)):
        native._made.__wrapped__()


def test_a_compiler_may_have_options(monkeypatch):
    monkeypatch.setenv("CXX", "c++ -O1")
    assert native._compiler() == ["c++", "-O1"]
