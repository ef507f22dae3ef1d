"""Where Eq. (7) has a body rest under a force, however far that is.

K_hat is the stiffness at one pose. A hand that yields by more than a few centimetres
moves its arm, and with it J. Letters: N poses, each with a force.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.character import Character, compose_scene
from dcc_jax.control import compliance
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.control.controller import Controller
from dcc_jax.env import features

Array = jax.Array

STEPS, RELAXED = 80, 0.25
"""Of the iteration, and how much of its way each step goes."""


class Bodies:
    """The centres of mass of some bodies in the frame of the pelvis."""

    def __init__(self, character: Character, names: Sequence[str]) -> None:
        """Of a character's bodies, by name."""
        model = compose_scene(character, floor=False)
        self.kinematics = features.Kinematics.of(model)
        self._at = jnp.array([character.body_names.index(name) for name in names])
        self._offset = jnp.array([model.body(x).ipos for x in names], jnp.float32)

    def centers(self, q: Array) -> Array:
        """[bodies, 3] m, at coordinates q [55]."""
        pos_w, quat_w = features.body_poses(self.kinematics, q)
        offset = quat.rotate(quat_w[self._at], self._offset)
        return quat.rotate(quat.inv(q[3:7]), pos_w[self._at] + offset - q[:3])


def yields_at_rest(
    character: Character,
    names: Sequence[str],
    alpha: float,
    q: np.ndarray,
    force: np.ndarray,
    body: np.ndarray,
) -> np.ndarray:
    """How far forces take the centres of mass of bodies at last, m [N, 3].

    Every joint yields as `compliance.yield_at_rest` says, with J at the pose to which
    all of them have yielded, so that joint ranges count. For a small force it is
    K_hat^-1 f.

    Args:
        character: whose pelvis does not move.
        names: of the bodies.
        alpha: level of compliance.
        q: coordinates without the force [N, 55].
        force: N, in the frame of the pelvis [N, 3].
        body: index into `names` [N].
    """
    bodies = Bodies(character, names)
    coords = bodies.kinematics.coords
    controller = Controller.of(ComplianceConfig(), character, coords, dt=1.0)

    @jax.jit
    @jax.vmap
    def moved(q: Array, force: Array, body: Array) -> Array:
        room = controller.room(q)

        def at(tangent: Array) -> Array:
            return quat.oplus(coords, q, quat.exp_map(coords, tangent))

        def torque(y: Array) -> Array:
            def along(tangent: Array) -> Array:
                pose = quat.oplus(coords, at(y), quat.exp_map(coords, tangent))
                return jnp.dot(force, bodies.centers(pose)[body])

            return jax.grad(along)(jnp.zeros_like(y)).at[:6].set(0.0)

        def step(_: Array, y: Array) -> Array:
            rest = compliance.yield_at_rest(
                controller, torque(y), jnp.float32(alpha), room
            )
            return y + RELAXED * (rest - y)

        y = jax.lax.fori_loop(0, STEPS, step, jnp.zeros(coords.nv))
        return bodies.centers(at(y))[body] - bodies.centers(q)[body]

    given = jnp.asarray(q, jnp.float32), jnp.asarray(force, jnp.float32)
    return np.asarray(moved(*given, jnp.asarray(body)))
