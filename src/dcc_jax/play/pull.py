"""A hand from outside: any task, with springs and pushes on any body on top.

The forces go the way of a task's own: `applied` gives them to the physics, `forces` to
the compliance controller. Letters: H hands, F forces of the task.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics, quat
from dcc_jax.env.task import Forces, RootTarget, Task
from dcc_jax.motion.reference import References, RefState

Array = jax.Array

HANDS = 2
PULL, PUSH = range(HANDS)
"""Which hand holds the spring, and which one pushes with a constant force."""
_DECLARED = tuple(
    name
    for name, kind in Task.__annotations__.items()
    if str(kind).startswith("ClassVar")
)
"""What a task says of itself beside its methods."""


@flax.struct.dataclass
class Hands:
    """What each hand does. Rows of zeros do nothing."""

    body: Array  # [H] int32, id of a body of the scene
    point: Array  # [H, 3] m, where on it, in its frame
    target_w: Array  # [H, 3] m, the other end of the spring
    stiffness: Array  # [H] N/m, of the spring
    damping: Array  # [H] N s/m, on the velocity of the point
    force_w: Array  # [H, 3] N, constant, on top


def no_hands() -> Hands:
    """Hands that do nothing."""
    one, three = np.zeros(HANDS, np.float32), np.zeros((HANDS, 3), np.float32)
    rows: dict[str, Any] = {
        "body": np.zeros(HANDS, np.int32),
        "point": three,
        "target_w": three,
        "stiffness": one,
        "damping": one,
        "force_w": three,
    }
    return Hands(**rows)


@flax.struct.dataclass
class PulledState:
    """The task's own state, and the hands."""

    task: Any
    hands: Hands


@dataclass(frozen=True)
class Pulled(Task):
    """A task with hands that pull and push at it."""

    task: Task
    name: ClassVar[str] = "pulled"

    def __post_init__(self) -> None:
        for name in _DECLARED:
            object.__setattr__(self, name, getattr(self.task, name))

    @property
    def has_floor(self) -> bool:
        """As the task says."""
        return self.task.has_floor

    def extend(self, spec: mujoco.MjSpec) -> None:
        """As the task does."""
        self.task.extend(spec)

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """As the task has it."""
        return self.task.first_reference(key, references, begin)

    def reference(
        self, references: References, state: PulledState, at: RefState, elapsed: float
    ) -> RefState:
        """As the task has it."""
        return self.task.reference(references, state.task, at, elapsed)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[PulledState, Array, Array]:
        """The task's own reset; no hand does anything."""
        state, qpos, qvel = self.task.reset(key, scene, reference)
        hands = jax.tree.map(jnp.asarray, no_hands())
        return PulledState(state, hands), qpos, qvel

    def control_step(
        self, key: Array, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> tuple[PulledState, physics.State]:
        """The task's own."""
        task, body = self.task.control_step(key, scene, state.task, body)
        return dataclasses.replace(state, task=task), body

    def root_target(
        self, scene: physics.Scene, state: PulledState, start: RootTarget, time: Array
    ) -> RootTarget:
        """As the task has it."""
        return self.task.root_target(scene, state.task, start, time)

    def applied(
        self,
        scene: physics.Scene,
        state: PulledState,
        kin: physics.Kinematics,
        time: Array,
    ) -> Array:
        """The task's own generalized forces, and J^T f of every hand [nv]."""
        own = self.task.applied(scene, state.task, kin, time)
        force_w, _, J = hand_forces(scene, kin, state.hands)
        return own + jnp.sum(J * force_w[:, :, None], axis=(0, 1))

    def world(self, scene: physics.Scene, state: PulledState, time: Array) -> Any:
        """As the task has it."""
        return self.task.world(scene, state.task, time)

    def forces(
        self,
        scene: physics.Scene,
        state: PulledState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[PulledState, Forces]:
        """The task's forces while its gate is open, and those of the hands, F + H.

        Who holds the ball or the door does not hold the character.
        """
        task, own = self.task.forces(scene, state.task, kin, solution, action)
        force_w, point_w, _ = hand_forces(scene, kin, state.hands)
        on_character = jnp.asarray(_is_character(scene))[state.hands.body]
        root = scene.body(scene.character.body_names[0])
        body = jnp.where(on_character, state.hands.body, root)
        return dataclasses.replace(state, task=task), Forces(
            force_w=jnp.concatenate(
                [
                    jnp.where(own.gate, own.force_w, 0.0),
                    jnp.where(on_character[:, None], force_w, 0.0),
                ]
            ),
            point_w=jnp.concatenate([own.point_w, point_w]),
            body=jnp.concatenate([own.body.astype(jnp.int32), body]),
            gate=jnp.ones((), bool),
        )

    def observe(
        self, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> Array:
        """As the task has it: a hand is felt, not seen."""
        return self.task.observe(scene, state.task, body)

    def reward(
        self, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> Array:
        """As the task has it."""
        return self.task.reward(scene, state.task, body)

    def terminated(
        self, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> Array:
        """As the task has it."""
        return self.task.terminated(scene, state.task, body)

    def ground_height(
        self, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> Array:
        """As the task has it."""
        return self.task.ground_height(scene, state.task, body)

    def evaluate(
        self, scene: physics.Scene, state: PulledState, body: physics.State
    ) -> dict[str, Array]:
        """As the task has it."""
        return self.task.evaluate(scene, state.task, body)


def hand_forces(
    scene: physics.Scene, kin: physics.Kinematics, hands: Hands
) -> tuple[Array, Array, Array]:
    """f = k (target - point) - d v + constant, of each hand.

    Returns:
        forces [H, 3], N, and the points where they act [H, 3], m, world;
        Jacobians of the points [H, 3, nv].
    """
    turn_w, place_w = kin.body_quat[hands.body], kin.body_pos[hands.body]
    point_w = place_w + quat.rotate(turn_w, hands.point)
    J = jax.vmap(lambda p, b: physics.point_jacobian(scene, kin, p, b))(
        point_w, hands.body
    )
    velocity_w = jnp.sum(J * kin.data.qvel, axis=-1)
    stretch = hands.stiffness[:, None] * (hands.target_w - point_w)
    drag = hands.damping[:, None] * velocity_w
    return stretch - drag + hands.force_w, point_w, J


def _is_character(scene: physics.Scene) -> np.ndarray:
    """Which bodies of the scene [nbody] are the character's."""
    root = scene.model.dof_bodyid[scene.dof_adr]
    return scene.model.body_rootid == root
