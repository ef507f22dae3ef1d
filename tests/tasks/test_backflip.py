"""What counts as a flip, when the plate kicks for one, and clips by name."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import physics
from dcc_jax.character import CONTROL_DT, asset_path, compose_scene, load_character
from dcc_jax.config import make_config
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks.backflip import Backflip
from dcc_jax.tasks.trampoline import Trampoline
from dcc_jax.training import loop

TASK = Trampoline()
SUBSTEPS = 8


@pytest.fixture(scope="module")
def scene() -> physics.Scene:
    character = load_character()
    model = compose_scene(character, floor=False, extend=TASK.extend)
    return physics.make_scene(model, character)


@pytest.fixture(scope="module")
def reference():
    clips = [load_clip(asset_path("motions/backflip.npz"))]
    return make_references(clips)


@pytest.fixture(scope="module")
def go_on(scene):
    """(state, pitch rate, load) -> the state a control step later.

    The pelvis turns forward at the pitch rate in rad/s; the load in N on each sole is
    zero in the air.
    """
    count = len(scene.contact_bodies)

    @jax.jit
    def step(state, rate, load):
        qvel = jnp.zeros(scene.model.nv).at[scene.dof_adr + 4].set(rate)
        qpos = jnp.asarray(scene.model.qpos0, jnp.float32)
        body = physics.initial_state(scene, qpos, qvel)
        state, _ = TASK.control_step(jax.random.key(0), scene, state, body)
        solution = physics.Solution(
            qacc=qvel,
            contact_force_w=jnp.zeros((count, 3)).at[:, 2].set(load),
            contact_point_w=jnp.zeros((count, 3)),
            equality_force=jnp.zeros(0),
        )

        def substep(state, _):
            return TASK.forces(scene, state, None, solution, jnp.zeros(36))[0], None

        return jax.lax.scan(substep, state, None, length=SUBSTEPS)[0]

    return step


@pytest.fixture(scope="module")
def standing(scene, reference):
    return TASK.reset(jax.random.key(0), scene, reference.state_at(0, 0.1))[0]


def flown(go_on, state, turn, seconds=0.7):
    """The state after a flight with `turn` rad forward, at its last moment."""
    steps = round(seconds / CONTROL_DT)
    for _ in range(steps):
        state = go_on(state, turn / (steps * CONTROL_DT), 0.0)
    return state


def stood(go_on, state, seconds):
    for _ in range(round(seconds / CONTROL_DT)):
        state = go_on(state, 0.0, 50.0)
    return state


@pytest.mark.parametrize(
    ("turn", "flips"), [(-2 * np.pi, 1.0), (2 * np.pi, 1.0), (-np.pi, 0.0), (0.0, 0.0)]
)
def test_a_whole_turn_that_is_landed_and_stood_is_a_flip(go_on, standing, turn, flips):
    state = stood(go_on, standing, 0.2)
    state = flown(go_on, state, turn)
    # The first control step of a flight ends with the feet just off the plate.
    assert float(state.turned) == pytest.approx(-turn, abs=0.07 * abs(turn) + 1e-6)
    state = stood(go_on, state, 0.5)
    assert float(state.flips) == 0.0
    state = stood(go_on, state, 0.7)
    assert float(state.flips) == flips
    assert float(stood(go_on, state, 1.5).flips) == flips


def test_a_bounce_after_the_flip_has_to_be_stood_too(go_on, standing):
    state = flown(go_on, stood(go_on, standing, 0.2), -2 * np.pi)
    state = flown(go_on, stood(go_on, state, 0.3), 0.0, seconds=0.3)
    state = stood(go_on, state, 0.8)
    assert float(state.flips) == 0.0
    assert float(stood(go_on, state, 0.4).flips) == 1.0


def test_an_evaluation_hears_of_turns_and_flips(scene, go_on, standing):
    state = flown(go_on, stood(go_on, standing, 0.2), -2 * np.pi)
    body = physics.initial_state(
        scene, jnp.asarray(scene.model.qpos0), jnp.zeros(scene.model.nv)
    )
    numbers = TASK.evaluate(scene, state, body)
    assert float(numbers["turned"]) > 5.5 and float(numbers["flips"]) == 0.0
    state = dataclasses.replace(state, flips=jnp.array(2.0))
    assert float(TASK.evaluate(scene, state, body)["flips"]) == 2.0


@pytest.mark.parametrize(
    ("time", "left"), [(0.2, 1.0), (1.3, -0.1), (1.5, 100.0), (2.5, 100.0)]
)
def test_the_plate_kicks_at_the_push_off_of_the_clip(scene, reference, time, left):
    state, _, _ = Backflip(kick_spread=0.0).reset(
        jax.random.key(1), scene, reference.state_at(0, time)
    )
    assert float(state.next_bounce) == pytest.approx(left, abs=1e-5)


def test_the_kick_comes_a_little_early_or_late(scene, reference):
    start = reference.state_at(0, 0.2)
    keys = jax.random.split(jax.random.key(2), 64)
    states, _, _ = jax.vmap(lambda key: Backflip().reset(key, scene, start))(keys)
    off = np.asarray(states.next_bounce) - 1.0
    assert np.abs(off).max() <= Backflip.kick_spread + 1e-6
    assert off.min() < -0.02 and off.max() > 0.02


def test_clips_are_files_or_names_of_the_packages_own():
    config = make_config("trampoline", "smoke")
    path = str(asset_path("motions/jump_high.npz"))
    env = dataclasses.replace(config.env, clips=("stand", path, "backflip"))
    environment = loop.make_environment(dataclasses.replace(config, env=env))
    frames = [
        len(load_clip(asset_path(f"motions/{n}.npz")).qpos)
        for n in ("stand", "jump_high", "backflip")
    ]
    np.testing.assert_array_equal(environment.references.frames, frames)
    # A crouch of the clips is no fall.
    lowest = environment.references.qpos[..., 2].min()
    assert lowest < 0.55 and environment.fallen.pelvis == pytest.approx(lowest - 0.1)
    env = dataclasses.replace(config.env, clips=("handstand",))
    with pytest.raises(ValueError, match="handstand"):
        loop.make_environment(dataclasses.replace(config, env=env))
