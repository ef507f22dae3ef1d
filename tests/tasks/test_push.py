"""Pushed balance: the obstacle that floats."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from dcc_jax import physics
from dcc_jax.character import GRAVITY, compose_scene, load_character
from dcc_jax.tasks.push import Push


def test_a_ball_that_floats_comes_level_and_has_no_weight():
    task = Push(floats=True, mass=10.0, speed=(0.5, 0.5))
    character = load_character()
    model = compose_scene(character, extend=task.extend)
    scene = physics.make_scene(model, character)
    body = physics.initial_state(scene, jnp.asarray(model.qpos0), jnp.zeros(model.nv))
    thrown = task._thrown(jax.random.key(0), scene, body)
    _, v_adr = scene.address("ball")
    velocity = thrown.qvel[v_adr : v_adr + 3]
    assert velocity[2] == 0.0
    np.testing.assert_allclose(jnp.linalg.norm(velocity), 0.5, rtol=1e-6)

    @jax.jit
    def passive(qpos: jax.Array) -> jax.Array:
        data = scene.template.replace(qpos=qpos)
        for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel, mjx.passive):
            data = stage(scene.mjx_model, data)
        return data.qfrc_passive

    lifted = passive(thrown.qpos)[v_adr : v_adr + 3]
    np.testing.assert_allclose(lifted, [0.0, 0.0, 10.0 * GRAVITY], atol=1e-4)
