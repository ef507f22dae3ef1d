"""The compiled kernel of J^T f against the same in JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import native, physics
from dcc_jax.character import compose_scene, load_character

pytestmark = pytest.mark.skipif(
    not native.available(), reason="no C++ compiler: J^T f is calculated in JAX"
)
BATCH, COUNT = 100, 3


def beside(spec) -> None:
    """A second tree: what a force does to it is about another centre of mass."""
    body = spec.worldbody.add_body(name="pad", pos=[2, 0, 1])
    body.add_geom(size=[0.1, 0.1, 0.1], mass=3.0, contype=0, conaffinity=0)
    body.add_freejoint()


@pytest.fixture(scope="module")
def scene() -> physics.Scene:
    character = load_character()
    return physics.make_scene(compose_scene(character, extend=beside), character)


@pytest.fixture(scope="module")
def given(scene) -> list[jax.Array]:
    """States, points, bodies that differ from environment to environment, forces.

    In the first register of environments none acts, in the others some.
    """
    rng = np.random.default_rng(0)
    qpos = scene.model.qpos0 + 0.1 * rng.normal(size=(BATCH, scene.model.nq))
    point = rng.normal(size=(BATCH, COUNT, 3))
    body = rng.integers(0, scene.model.nbody, (BATCH, COUNT))
    body[50:, 0] = scene.body("left_hand")
    force = 50.0 * rng.normal(size=point.shape) * (rng.random((BATCH, COUNT, 1)) < 0.5)
    force[:16] = 0.0
    floats = [jnp.asarray(x, jnp.float32) for x in (qpos, point, force)]
    return [*floats[:2], jnp.asarray(body), floats[2]]


def pulled(scene, *given) -> np.ndarray:
    def one(qpos, point, body, force):
        kin = physics.kinematics(
            scene, physics.initial_state(scene, qpos, jnp.zeros(scene.model.nv))
        )
        return physics.generalized_force(scene, kin, point, body, force)

    return np.asarray(jax.jit(jax.vmap(one))(*given))


@pytest.mark.parametrize("count", [1, COUNT])
def test_kernel_finds_what_jax_finds(scene, given, count, monkeypatch):
    qpos, *of_forces = given
    some = [qpos, *(x[:, :count] for x in of_forces)]
    ours = pulled(scene, *some)
    monkeypatch.setattr(native, "available", lambda: False)
    theirs = pulled(scene, *some)
    np.testing.assert_allclose(ours, theirs, atol=2e-6 * np.abs(theirs).max())
    assert not ours[:16].any() and np.abs(ours[:, -6:]).max() > 10.0


def test_an_environment_is_the_same_to_the_bit_wherever_it_is(scene, given):
    whole = pulled(scene, *given)
    for first in (5, BATCH - 1):
        np.testing.assert_array_equal(
            pulled(scene, *(x[first:] for x in given)), whole[first:]
        )


def test_who_is_not_pulled_has_no_force_whoever_is_beside(scene, given):
    """Not even where a state is not a number; it stays there."""
    qpos, point, body, force = given
    force = force.at[20].set(0.0).at[21].set(100.0)
    clean = pulled(scene, qpos, point, body, force)
    qpos, point = qpos.at[20].set(jnp.nan), point.at[20].set(jnp.nan)
    spoiled = pulled(scene, qpos, point, body, force)
    np.testing.assert_array_equal(spoiled, clean)
    assert not spoiled[20].any() and spoiled[21].any()
