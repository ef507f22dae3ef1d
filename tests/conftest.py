"""Shared fixtures. Physics programs compile in tens of seconds: one serves them all."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

from dcc_jax import runtime

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
