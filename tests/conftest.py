"""Shared fixtures. Physics programs compile in tens of seconds: one serves them all."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import quick
from dcc_jax import runtime

os.environ["XLA_FLAGS"] = quick.flags(os.environ)
# Tracing makes objects by the million, and few of them are garbage.
gc.set_threshold(100_000, 50, 50)
runtime.ensure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import pytest  # noqa: E402

from dcc_jax import physics  # noqa: E402
from dcc_jax.character import Character, compose_scene, load_character  # noqa: E402

jax.config.update("jax_debug_key_reuse", True)


@pytest.fixture(scope="session")
def character() -> Character:
    return load_character()


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """(task) -> the run directory of a policy trained for two updates, made once."""
    import smoke

    return cache(lambda task: smoke.smoke_run(task, tmp_path_factory))


@pytest.fixture(scope="session")
def scene(character: Character) -> physics.Scene:
    """The character on the floor at 240 Hz, solver at the default setting."""
    return physics.make_scene(compose_scene(character), character)


@pytest.fixture(scope="session")
def compiled_solve(scene: physics.Scene):
    """(state, qfrc, wrench) -> (solution, M^-1 wrench, J of both feet), batched."""

    def probe(state: physics.State, qfrc: jax.Array, wrench: jax.Array):
        kin = physics.kinematics(scene, state)
        feet = jnp.array([scene.body("left_foot"), scene.body("right_hand")])
        J = jax.vmap(lambda b: physics.point_jacobian(scene, kin, kin.body_pos[b], b))(
            feet
        )
        return (
            physics.solve(scene, kin, state, qfrc),
            physics.mass_solve(scene, kin, wrench),
            J,
            kin.body_pos,
        )

    return jax.jit(jax.vmap(probe))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share programs run on one worker, the longest groups first.

    A group is a file, or what the mark `xdist_group` names.
    """
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))
    items.sort(key=lambda item: not _compiles_long(item))


def _compiles_long(item: pytest.Item) -> bool:
    return item.path.parent.name == "tasks" or item.path.name == "test_skills.py"
