"""The law `admittance` by the compiled kernel against the same in JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import native, quat
from dcc_jax.character import asset_path, load_character
from dcc_jax.control import admittance_kernel, compliance
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.control.controller import Controller, Displacement
from dcc_jax.control.ranges import Room
from dcc_jax.motion.clip import load_clip

pytestmark = pytest.mark.skipif(
    not native.available(), reason="no C++ compiler: u is calculated in JAX"
)
CHARACTER = load_character()
COORDS = quat.Coordinates.of(CHARACTER.spec().compile())
BATCH = 200
CLIPS = "stand", "run_cycle", "backflip"
# Displacements, torques, levels of compliance and rooms of a batch.
Given = tuple[Displacement, jax.Array, jax.Array, Room | None]


@pytest.fixture(scope="module")
def controller() -> Controller:
    """Of weights that differ, so that no joint can stand for another."""
    rng = np.random.default_rng(1)
    made = Controller.of(ComplianceConfig(), CHARACTER, COORDS, 1.0 / 240.0)
    weights = rng.uniform(0.2, 2.0, COORDS.nv) * (rng.random(COORDS.nv) > 0.1)
    return Controller(
        made.config, COORDS, weights, made.dt, kp=made.kp, ranges=made.ranges
    )


@pytest.fixture(scope="module")
def given(controller: Controller) -> Given:
    """Displacements on their way, torques from none to far too large, in any pose."""
    rng = np.random.default_rng(0)
    poses = [load_clip(asset_path(f"motions/{c}.npz")).qpos for c in CLIPS]
    q_m = np.concatenate(poses)[rng.integers(0, sum(map(len, poses)), BATCH)]
    size = (BATCH, COORDS.nv)
    torque = 10.0 ** rng.uniform(-6, 3, (BATCH, 1)) * rng.normal(size=size)
    y = 10.0 ** rng.uniform(-6, 1, (BATCH, 1)) * rng.normal(size=size)
    torque[:20], y[:20] = 0.0, 0.0
    alpha = rng.uniform(0.0, 0.95, BATCH)
    alpha[10:40] = 0.0
    numbers = q_m, torque, y, rng.normal(size=size), alpha
    q_m, torque, y, yd, alpha = (jnp.asarray(x, jnp.float32) for x in numbers)
    yd = yd.at[:10].set(0.0)
    rest = compliance.at_rest(COORDS)
    before = Displacement(
        u=jnp.tile(rest.u, (BATCH, 1)), ud=jnp.zeros(size), y=y, yd=yd
    )
    return before, torque, alpha, jax.vmap(controller.room)(q_m)


def stepped(controller: Controller, *given) -> Displacement:
    return jax.vmap(lambda *x: admittance_kernel.admittance(controller, *x))(*given)


def test_kernel_finds_what_jax_finds(controller, given, monkeypatch):
    ours = stepped(controller, *given)
    monkeypatch.setattr(native, "available", lambda: False)
    theirs = jax.vmap(lambda *x: compliance.admittance(controller, *x))(*given)
    y = np.asarray(ours.y)
    for found, expected, size in (
        (ours.u, theirs.u, 1.0),
        (ours.ud, theirs.ud, 1.0 + np.abs(ours.yd)),
        (ours.y, theirs.y, 1.0 + np.abs(y)),
        (ours.yd, theirs.yd, 1.0 + np.abs(ours.yd)),
    ):
        assert np.max(np.abs(np.asarray(found - expected)) / size) < 2e-6
    assert np.abs(y).max() > 10.0, "the bounds have to matter"


def test_who_has_no_yield_has_no_displacement_to_the_bit(controller, given):
    u = stepped(controller, *given).u
    np.testing.assert_array_equal(u[:10], jnp.tile(given[0].u[0], (10, 1)))


def test_an_environment_is_the_same_to_the_bit_wherever_it_is(controller, given):
    whole = stepped(controller, *given)
    for first in (3, BATCH - 1):
        rest = jax.tree.map(lambda x, first=first: x[first:], given)
        again = stepped(controller, *rest)
        for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(whole), strict=True):
            np.testing.assert_array_equal(a, b[first:])


def test_what_is_not_a_number_stays_in_its_environment(controller, given):
    before, torque, alpha, room = given
    clean = stepped(controller, *given).u
    spoiled = stepped(controller, before, torque.at[4].set(jnp.nan), alpha, room).u
    others = np.arange(BATCH) != 4
    assert np.isnan(spoiled[4]).all()
    np.testing.assert_array_equal(spoiled[others], clean[others])


def test_the_law_chooses_the_kernel_where_it_serves(controller, given, monkeypatch):
    one = jax.tree.map(lambda x: x[0], given)

    def program(*given) -> str:
        made = jax.make_jaxpr(lambda *x: compliance.admittance(controller, *x))
        return str(made(*given))

    assert "ffi_call" in program(*one)
    assert "ffi_call" not in program(*one[:3], None), "nothing bounds u"
    monkeypatch.setattr(native, "available", lambda: False)
    assert "ffi_call" not in program(*one)
