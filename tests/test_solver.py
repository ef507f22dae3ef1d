"""The arrow-shaped solver against dense linear algebra in double precision."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import physics, tasks
from dcc_jax.character import Character, compose_scene
from dcc_jax.physics import contact_solver
from dcc_jax.physics.sparsity import arrow

BATCH = 3


@pytest.fixture(scope="module", params=("push", "trampoline", "door"))
def scene(request, character: Character) -> physics.Scene:
    """Scenes with a free body, a moving ground, equalities."""
    task = tasks.make_task(request.param)
    model = compose_scene(character, floor=task.has_floor, extend=task.extend)
    return physics.make_scene(model, character)


@pytest.fixture(scope="module")
def shape(scene: physics.Scene):
    return scene.arrow


def _problem(shape, seed: int) -> dict[str, np.ndarray]:
    """Random matrices with non-zeros wherever the shape has room for them."""
    rng = np.random.default_rng(seed)
    room = _room(shape)
    mass = room * 0.1 * rng.normal(size=(BATCH, shape.nv, shape.nv))
    mass = mass + mass.swapaxes(1, 2) + np.diag(rng.uniform(8, 9, shape.nv))
    J = _row_room(shape) * rng.normal(size=(BATCH, shape.num_rows, shape.nv))
    rows = (BATCH, shape.num_rows)
    return {
        "mass": mass,
        "smooth": rng.normal(size=(BATCH, shape.nv)),
        "J": J,
        "D": rng.uniform(0.5, 2.0, rows),
        "aref": rng.normal(size=rows),
        "start": rng.normal(size=(BATCH, shape.nv)),
    }


def _room(shape) -> np.ndarray:
    """[nv, nv] where M may be non-zero."""
    room = np.zeros((shape.nv + 1, shape.nv + 1), bool)
    core = np.append(shape.core, shape.nv)
    for stack in shape.stacks:
        for dofs, coupled in zip(stack.dofs, core[stack.core], strict=True):
            room[np.ix_(dofs, np.append(dofs, coupled))] = True
    room |= room.T
    room[np.ix_(core, core)] = True
    return room[:-1, :-1]


def _row_room(shape) -> np.ndarray:
    """[R, nv] where J may be non-zero."""
    room = np.zeros((shape.num_rows + 1, shape.nv + 1), bool)
    core = np.append(shape.core, shape.nv)
    for stack in shape.stacks:
        columns = np.concatenate([stack.dofs, core[stack.core]], axis=1)
        room[stack.rows[:, :, None], columns[:, None]] = True
    room[np.ix_(shape.core_rows, shape.core)] = True
    return room[:-1, :-1]


def test_every_unknown_and_every_row_has_one_place(shape):
    dofs = np.concatenate([*(s.dofs.ravel() for s in shape.stacks), shape.core])
    rows = np.concatenate([*(s.rows.ravel() for s in shape.stacks), shape.core_rows])
    assert sorted(dofs[dofs < shape.nv]) == list(range(shape.nv))
    assert sorted(rows[rows < shape.num_rows]) == list(range(shape.num_rows))


def test_mass_solve_is_the_dense_one(scene):
    shape = scene.mass_arrow
    assert len(shape.core) == 9, "pelvis and spine: without contacts nothing else"
    p = _problem(shape, 0)
    forces = np.stack([p["smooth"], p["start"]], axis=1)
    less = np.linspace(0.0, 2.0, shape.nv)
    solve = jax.jit(jax.vmap(lambda m, f: contact_solver.solve_mass(shape, m, less, f)))
    x = solve(jnp.asarray(p["mass"], jnp.float32), jnp.asarray(forces, jnp.float32))
    mass = p["mass"] - np.diag(less)
    dense = np.linalg.solve(mass, forces.swapaxes(1, 2)).swapaxes(1, 2)
    np.testing.assert_allclose(x, dense, atol=2e-6)


@pytest.fixture(scope="module")
def solved(shape) -> Callable[[int, list], tuple[jax.Array, jax.Array]]:
    """(most iterations, problem) -> accelerations and forces; one program for all."""

    @jax.jit
    def all_of(most: jax.Array, problem: list) -> tuple[jax.Array, jax.Array]:
        def one(mass, smooth, J, D, aref, start):
            rows = contact_solver.Rows(J, D, aref, _num_equality(shape))
            return contact_solver.newton(shape, mass, smooth, rows, start, most)

        return jax.vmap(one)(*problem)

    return lambda most, problem: all_of(jnp.int32(most), problem)


def _num_equality(shape) -> int:
    return min(5, shape.num_rows)


def test_optimum_satisfies_the_conditions_of_the_convex_problem(shape, solved):
    """M a - smooth = J^T f, with f = -D x where active and 0 elsewhere."""
    p = _problem(shape, 1)
    single = [jnp.asarray(value, jnp.float32) for value in p.values()]
    qacc, force = (np.asarray(x, float) for x in solved(8, single))
    x = np.einsum("bri,bi->br", p["J"], qacc) - p["aref"]
    active = (x < 0) | (np.arange(shape.num_rows) < _num_equality(shape))
    assert 0.2 < active.mean() < 0.9, "both kinds of rows must occur"
    np.testing.assert_allclose(force, -np.where(active, p["D"] * x, 0.0), atol=2e-5)
    balance = np.einsum("bij,bj->bi", p["mass"], qacc) - p["smooth"]
    np.testing.assert_allclose(
        balance, np.einsum("bri,br->bi", p["J"], force), atol=5e-5
    )
    alike = [jnp.repeat(value[:1], BATCH, axis=0) for value in single]
    np.testing.assert_allclose(solved(8, alike)[0], qacc[[0] * BATCH], atol=2e-5)


def test_iteration_stops_where_it_has_arrived_and_no_environment_notices_others(
    shape, solved
):
    """More iterations allowed, or easier problems beside it: not a bit changes."""
    p = [jnp.asarray(value, jnp.float32) for value in _problem(shape, 3).values()]
    qacc, force = solved(20, p)
    np.testing.assert_array_equal(force, solved(50, p)[1])
    assert np.abs(solved(1, p)[1] - force).max() > 1e-3, "one step is not enough"
    # The first starts at its solution now and waits for the others.
    easier = [*p[:5], p[5].at[0].set(qacc[0])]
    np.testing.assert_allclose(solved(20, easier)[1], force, atol=2e-5)
    np.testing.assert_array_equal(solved(20, easier)[1][1:], force[1:])


def test_limbs_that_touch_each_other_are_solved_together():
    """A row between two limbs makes one limb of them; the answer stays exact."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/>"
        + "<body pos='.2 0 0'><joint type='ball'/><geom size='.1'/></body>" * 2
        + "</body></worldbody></mujoco>"
    )
    apart = arrow(model, np.zeros((0, model.nv), bool))
    row = np.ones((1, model.nv), bool)
    joined = arrow(model, row)
    assert [stack.dofs.shape for stack in apart.stacks] == [(2, 3)]
    assert [stack.dofs.shape for stack in joined.stacks] == [(1, 6)]
    p = _problem(joined, 2)

    def one(mass, smooth, J, D, aref, start):
        return contact_solver.newton(
            joined, mass, smooth, contact_solver.Rows(J, D, aref, 1), start, 2
        )

    single = [jnp.asarray(value, jnp.float32) for value in p.values()]
    qacc, _ = jax.jit(jax.vmap(one))(*single)
    J, D = p["J"], p["D"][..., None]
    H = p["mass"] + J.swapaxes(1, 2) @ (D * J)
    right = p["smooth"] + np.einsum("bri,br->bi", J, p["D"] * p["aref"])
    np.testing.assert_allclose(
        qacc, np.linalg.solve(H, right[..., None])[..., 0], atol=2e-6
    )
    alone, _ = jax.jit(one)(*(value[0] for value in single))
    np.testing.assert_allclose(alone, qacc[0], atol=2e-6)
