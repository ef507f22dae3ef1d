"""What the policy observes (Sec. 4.2), and where things are in it.

One vector: the 306 numbers of the state, the way to the reference's root and its
velocity over the ground, alpha, the reference's phase where it goes on in time, the
pose that is tracked, and the task's own numbers. Everything is written for ONE
environment.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dcc_jax import physics, quat
from dcc_jax.character import Character
from dcc_jax.env import expert, features
from dcc_jax.env.features import STATE_SIZE, Kinematics
from dcc_jax.env.state import EnvState
from dcc_jax.env.task import RootTarget, Task

Array = jax.Array

ALPHA_ENTRY = STATE_SIZE + 4
"""Where alpha is: behind the way to the root and its velocity, two numbers each."""
PHASE_SIZE = 3
POSE_SIZE = 4 + Character.num_joint_dofs
"""Numbers of `of_pose`."""


def size(task: Task, has_phase: bool, has_pose: bool) -> int:
    """How many numbers a policy observes, with phase and pose or without."""
    of_reference = has_phase * PHASE_SIZE + has_pose * POSE_SIZE
    return ALPHA_ENTRY + 1 + of_reference + task.state_size


def observation(
    task: Task,
    scene: physics.Scene,
    kinematics: Kinematics,
    state: EnvState,
    target: RootTarget,
    has_phase: bool,
    pose: Array,
) -> Array:
    """The observation [O] of a state.

    Args:
        task: of the environment.
        scene: likewise.
        kinematics: of the character.
        state: now.
        target: the reference's root now.
        has_phase: whether the reference's phase is in it.
        pose: of the reference, [POSE_SIZE] of `of_pose`; or nothing, [0].

    Raises:
        ValueError: the task observes another number of numbers than its `state_size`.
    """
    q = scene.character_qpos(state.body.qpos)
    numbers = features.state(
        kinematics, q, state.q_previous, state.displacement.u, state.u_previous
    )
    seen = task.observe(scene, state.task, state.body)
    if seen.shape != (task.state_size,):
        raise ValueError(
            f"{type(task).__name__}.observe gives {list(seen.shape)} numbers, its "
            f"state_size is {task.state_size}"
        )
    offset = target.position + state.displacement.u[:2] - q[:2]
    parts = [
        numbers,
        _seen_from(q, offset),
        _seen_from(q, target.velocity),
        state.alpha[None],
        of_phase(state.reference.phase) if has_phase else jnp.zeros(0),
        pose,
        seen,
    ]
    return jnp.concatenate(parts)


def of_phase(phase: Array) -> Array:
    """A phase [] in [0, 1] as it is observed [3]: as it is, and as a point of the
    circle, where a stride's end is its beginning."""
    turn = 2.0 * jnp.pi * phase
    return jnp.stack([phase, jnp.cos(turn), jnp.sin(turn)])


def of_pose(
    kinematics: Kinematics, q: Array, reference: Array, nominal: Array
) -> Array:
    """A reference's pose as it is observed, [40].

    Its height (m), the rotation vector (rad) from the character's root to its root, and
    those of its joints from the nominal pose.

    Args:
        kinematics: of the character.
        q: the character's coordinates [55].
        reference: the reference's [55].
        nominal: the pose that actions are small around [55].
    """
    coords = kinematics.coords
    _, here = coords.split_q(q)
    _, there = coords.split_q(reference)
    turn = quat.log(quat.mul(quat.inv(here[:1]), there[:1]))
    joints = expert.action(kinematics, nominal, reference)
    return jnp.concatenate([reference[2:3], turn.ravel(), joints])


def _seen_from(q: Array, vector: Array) -> Array:
    """A vector [2] on the ground in the local frame of the character's q [55]."""
    _, heading = features.local_frame(q)
    return quat.rotate(quat.inv(heading), jnp.append(vector, 0.0))[:2]
