"""The contact solver's compiled kernel against the solver in JAX, on a small arrow."""

from __future__ import annotations

import subprocess

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax.physics import contact_solver, native
from dcc_jax.physics.sparsity import arrow

ITERATIONS, EQUALITIES, ROWS = 8, 2, 12
MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/>"
    + (
        "<body pos='.2 0 0'><joint type='ball'/><geom size='.1'/>"
        "<body pos='.2 0 0'><joint axis='0 1 0'/><geom size='.1'/></body></body>"
    )
    * 2
    + "</body></worldbody></mujoco>"
)


def row_pattern() -> np.ndarray:
    """[R, nv]: four rows on each limb and the root, four on the root alone."""
    pattern = np.zeros((ROWS, MODEL.nv), bool)
    pattern[:, :6] = True
    pattern[:4, 6:10] = True
    pattern[4:8, 10:14] = True
    return pattern


SHAPE = arrow(MODEL, row_pattern())
needs_kernel = pytest.mark.skipif(
    not native.available(), reason="no C++ compiler: the solver runs in JAX"
)


def problem(batch: int, seed: int = 0) -> list[np.ndarray]:
    """Mass, smooth forces, J, D, aref and start of `batch` environments."""
    rng = np.random.default_rng(seed)
    related = row_pattern().T.astype(int) @ row_pattern() > 0
    mass = related * 0.1 * rng.normal(size=(batch, MODEL.nv, MODEL.nv))
    mass = mass + mass.swapaxes(1, 2) + np.diag(rng.uniform(8, 9, MODEL.nv))
    J = row_pattern() * rng.normal(size=(batch, ROWS, MODEL.nv))
    rows, vector = (batch, ROWS), (batch, MODEL.nv)
    given = (
        mass,
        rng.normal(size=vector),
        J,
        rng.uniform(0.5, 2.0, rows),
        rng.normal(size=rows),
        rng.normal(size=vector),
    )
    return [x.astype(np.float32) for x in given]


def kernel(*given):
    return native.newton(SHAPE, EQUALITIES, ITERATIONS, *given)


def in_jax(*given):
    solve = contact_solver._batch_last(
        lambda *x: contact_solver._newton(SHAPE, EQUALITIES, ITERATIONS, *x)
    )
    return solve(*given)


@needs_kernel
@pytest.mark.parametrize("batch", [1, 7, 33])
def test_kernel_finds_what_the_solver_in_jax_finds(batch):
    given = problem(batch)
    for ours, theirs in zip(
        jax.vmap(kernel)(*given), jax.vmap(in_jax)(*given), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


@needs_kernel
def test_an_environment_is_solved_the_same_to_the_bit_wherever_it_is():
    given = problem(40)
    qacc, force = jax.vmap(kernel)(*given)
    for first in (0, 3, 39):
        rest = [x[first:] for x in given]
        again = jax.vmap(kernel)(*rest)
        np.testing.assert_array_equal(again[0], qacc[first:])
        np.testing.assert_array_equal(again[1], force[first:])
    np.testing.assert_array_equal(kernel(*(x[5] for x in given))[0], qacc[5])


@needs_kernel
def test_a_batch_of_batches_is_one_batch():
    given = problem(12)
    qacc, force = jax.vmap(kernel)(*given)
    nested = jax.vmap(jax.vmap(kernel))(*(x.reshape(3, 4, *x.shape[1:]) for x in given))
    np.testing.assert_array_equal(nested[0].reshape(qacc.shape), qacc)
    np.testing.assert_array_equal(nested[1].reshape(force.shape), force)


@needs_kernel
def test_what_is_not_a_number_stays_in_its_environment():
    given = problem(10)
    qacc, _ = jax.vmap(kernel)(*given)
    given[1][4] = np.nan
    spoiled, _ = jax.vmap(kernel)(*given)
    others = np.arange(10) != 4
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
    assert said.count("\n") == 1 and "contact solver in JAX" in said and reason in said
    shape, rows = SHAPE, problem(1)
    single = [jnp.asarray(x[0]) for x in rows]
    rows = contact_solver.Rows(*single[2:5], EQUALITIES)
    given = shape, single[0], single[1], rows, single[5], ITERATIONS
    text = str(jax.make_jaxpr(lambda: contact_solver.newton(*given))())
    assert "ffi_call" not in text


def test_the_kernel_can_be_switched_off(forgetful):
    forgetful.setenv(native.SETTING, "0")
    assert not native.available()


def test_source_of_the_kernel_travels_with_the_package():
    assert native.SOURCE.is_file()
