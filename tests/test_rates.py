"""Every physics rate keeps characters alive that nobody controls well."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import physics, quat
from dcc_jax.character import Character, compose_scene
from dcc_jax.control import pd

COUNT = 64


def _run(scene: physics.Scene, seconds: float):
    """(state, targets [3, 55]) -> last state, total floor force [steps, 3]."""

    def one(state: physics.State, targets: jax.Array):
        def step(carry, i):
            # A new random target every second.
            target = targets[jnp.int32(i * scene.timestep)]
            tau = pd.torque(
                scene.character, carry.qpos, carry.qvel, target, scene.timestep
            )
            kin = physics.kinematics(scene, carry)
            solution = physics.solve(scene, kin, carry, scene.scatter_character(tau))
            force = solution.contact_force_w.sum(axis=0)
            return physics.integrate(scene, carry, solution), force

        return jax.lax.scan(step, state, jnp.arange(round(seconds / scene.timestep)))

    return jax.jit(jax.vmap(one))


@pytest.mark.slow
@pytest.mark.parametrize("rate", [600, 450, 300, 240, 180])
def test_dropped_characters_survive_and_quiet_ones_weigh_what_they_weigh(
    rate: int, character: Character
):
    model = compose_scene(character, timestep=1.0 / rate)
    scene = physics.make_scene(model, character)
    rng = np.random.default_rng(rate)
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def turned(size: float, shape: tuple[int, ...]) -> jax.Array:
        tangent = size * rng.normal(size=(*shape, model.nv))
        tangent[..., :3] = 0.0
        rotation = quat.exp_map(scene.coords, jnp.asarray(tangent, jnp.float32))
        return quat.oplus(
            scene.coords, jnp.broadcast_to(rest, rotation.shape), rotation
        )

    # The last one stands quietly in its rest pose; the others fall from 1 m, tumbling.
    dropped = turned(0.6, (COUNT - 1,)).at[:, 2].add(1.0)
    qpos = jnp.concatenate([dropped, rest[None]])
    targets = jnp.concatenate(
        [turned(0.4, (COUNT - 1, 3)), jnp.broadcast_to(rest, (1, 3, len(rest)))]
    )
    states = jax.vmap(lambda q: physics.initial_state(scene, q, jnp.zeros(model.nv)))(
        qpos
    )
    after, force = _run(scene, 3.0)(states, targets)
    assert np.isfinite(after.qpos).all() and np.isfinite(after.qvel).all()
    assert np.abs(after.qvel).max() < 100.0, "nothing may be about to explode"

    early = force[-1, round(0.4 * rate) : round(0.6 * rate), 2]
    weight = 9.81 * model.body_mass.sum()
    np.testing.assert_allclose(early.mean(), weight, rtol=0.01)
