"""Pushed balance: the obstacle that floats."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from dcc_jax import physics
from dcc_jax.character import GRAVITY, compose_scene, load_character
from dcc_jax.tasks.push import Push


def test_ball_and_character_push_each_other_as_their_jacobians_say():
    task, character = Push(), load_character()
    model = compose_scene(character, extend=task.extend)
    scene = physics.make_scene(model, character)
    rng = np.random.default_rng(0)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 0.5)
    bodies = jnp.array([scene.body("chest"), scene.body("ball"), scene.body("ball")])
    point_w, force_w = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)

    @jax.jit
    def both(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        body = physics.initial_state(scene, qpos, jnp.zeros(model.nv))
        kin = physics.kinematics(scene, body)
        at = jax.vmap(lambda p, b: physics.point_jacobian(scene, kin, p, b))
        each = jnp.sum(at(point_w, bodies) * force_w[:, :, None], axis=(0, 1))
        summed = physics.generalized_force(scene, kin, point_w, bodies, force_w)
        return summed, each

    summed, each = both(jnp.asarray(qpos, jnp.float32))
    _, v_adr = scene.address("ball")
    assert np.abs(each[v_adr : v_adr + 3]).min() > 0.1
    np.testing.assert_allclose(summed, each, atol=1e-5)


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
