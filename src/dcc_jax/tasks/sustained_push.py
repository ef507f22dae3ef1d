"""Sustained pushes (Sec. 5.2): stand, walk and run while forces pull at the body.

Every now and then a force of constant direction acts on one body for a while, as wind
or a dog on a lead would. It is fed to the compliance as it is. Loops of walking and
running carry the reference's root along.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import physics
from dcc_jax.env.task import Forces, Task, place_character
from dcc_jax.motion.reference import CONTROL_DT, RefState

Array = jax.Array


@flax.struct.dataclass
class State:
    """The push that acts, and when it ends or the next one begins."""

    force_w: Array  # [3] N, zero in a pause
    target: Array  # [] int32, index into `SustainedPush.bodies`
    left: Array  # [] s of the push, or of the pause
    since: Array  # [] s since the last push began


@dataclass(frozen=True)
class SustainedPush(Task):
    """Stand, walk or run, whoever pulls."""

    name: ClassVar[str] = "sustained-push"
    clips: ClassVar[tuple[str, ...]] = (
        "stand",
        "balance",
        "walk_cycle",
        "jog_cycle",
        "run_cycle",
    )
    clock: ClassVar[str | None] = "since_push"

    bodies: tuple[str, ...] = ("pelvis", "chest", "head", "left_hand", "right_hand")
    """That may be pushed, at their centres of mass."""
    strength: tuple[float, float] = (20.0, 80.0)
    """N; a tenth of the weight, and more, for seconds."""
    duration: tuple[float, float] = (1.0, 3.0)
    """s of a push."""
    pause: tuple[float, float] = (0.5, 1.5)
    """s between two."""
    slope: float = 0.3
    """rad, at most, of the force above or below the ground plane."""

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[State, Array, Array]:
        """It begins in a pause."""
        state = State(
            force_w=jnp.zeros(3),
            target=jnp.zeros((), jnp.int32),
            left=self.pause[1] * jax.random.uniform(key),
            since=jnp.zeros(()),
        )
        return state, *place_character(scene, reference)

    def control_step(
        self, key: Array, scene: physics.Scene, state: State, body: physics.State
    ) -> tuple[State, physics.State]:
        """Pushes and pauses take turns."""
        rest_key, push_key = jax.random.split(key)
        over = state.left <= 0.0
        pushing = jnp.any(state.force_w != 0.0)
        changed = jax.tree.map(
            lambda a, b: jnp.where(pushing, a, b),
            self._resting(rest_key, state),
            self._pushing(push_key),
        )
        state = jax.tree.map(lambda a, b: jnp.where(over, a, b), changed, state)
        return dataclasses.replace(
            state, left=state.left - CONTROL_DT, since=state.since + CONTROL_DT
        ), body

    def _resting(self, key: Array, state: State) -> State:
        shortest, longest = self.pause
        left = jax.random.uniform(key, minval=shortest, maxval=longest)
        return dataclasses.replace(state, force_w=jnp.zeros(3), left=left)

    def _pushing(self, key: Array) -> State:
        keys = jax.random.split(key, 5)
        way = jax.random.uniform(keys[0], minval=-jnp.pi, maxval=jnp.pi)
        slope = jax.random.uniform(keys[1], minval=-self.slope, maxval=self.slope)
        weak, strong = self.strength
        size = jax.random.uniform(keys[2], minval=weak, maxval=strong)
        level = jnp.cos(slope)
        direction = jnp.stack(
            [level * jnp.cos(way), level * jnp.sin(way), jnp.sin(slope)]
        )
        shortest, longest = self.duration
        return State(
            force_w=size * direction,
            target=jax.random.randint(keys[3], (), 0, len(self.bodies)),
            left=jax.random.uniform(keys[4], minval=shortest, maxval=longest),
            since=jnp.zeros(()),
        )

    def applied(
        self, scene: physics.Scene, state: State, kin: physics.Kinematics, time: Array
    ) -> Array:
        """J^T f at the body's centre of mass."""
        body, point = self._place(scene, state, kin)
        return state.force_w @ physics.point_jacobian(scene, kin, point, body)

    def forces(
        self,
        scene: physics.Scene,
        state: State,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[State, Forces]:
        """The push itself, F = 1."""
        body, point = self._place(scene, state, kin)
        return state, Forces(
            force_w=state.force_w[None],
            point_w=point[None],
            body=body[None],
            gate=jnp.ones((), bool),
        )

    def _place(
        self, scene: physics.Scene, state: State, kin: physics.Kinematics
    ) -> tuple[Array, Array]:
        """The body pushed [] and its centre of mass [3]."""
        body = jnp.array([scene.body(name) for name in self.bodies])[state.target]
        return body, kin.body_center[body]

    def evaluate(
        self, scene: physics.Scene, state: State, body: physics.State
    ) -> dict[str, Array]:
        """The push (N), the speed of the root over the ground (m/s), and the time since
        the last push began (s)."""
        velocity = scene.character_qvel(body.qvel)[:2]
        return {
            "push": jnp.sqrt(jnp.sum(jnp.square(state.force_w)) + 1e-12),
            "speed": jnp.sqrt(jnp.sum(jnp.square(velocity)) + 1e-12),
            "since_push": state.since,
        }
