"""Locomotion (Sec. 4.1): stand, walk, jog, run and turn as commanded.

The root of the reference goes along a path with stops, turns and changes of speed, and
nothing else is said of the motion: no clip is followed in time and nothing plans. What
the character does with its limbs it learns from all clips thrown together, by r_q and
r_p alone (Eq. (11), (14)). The path waits for who is left behind and gives way to who
is carried off: it goes on from within `leash` of the character.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import physics, quat
from dcc_jax.env import features
from dcc_jax.env.task import RootTarget, Task, place_character
from dcc_jax.motion import paths, planner
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.motion.reference import RefState

Array = jax.Array

SEEN = 6
"""Numbers of `seen`."""


@flax.struct.dataclass
class LocomotionState:
    """Where the character should go."""

    motion: Motion


@dataclass(frozen=True)
class Locomotion(Task):
    """Stand, walk, jog or run as commanded."""

    name: ClassVar[str] = "locomotion"
    clips: ClassVar[tuple[str, ...]] = (
        *planner.LOOPS,
        *("walk", "walk_left", "walk_right"),
        *("jog", "jog_left", "jog_right"),
        *("run", "run_left", "run_right"),
    )
    state_size: ClassVar[int] = SEEN
    trackable: ClassVar[bool] = False
    config_overrides: ClassVar[Mapping[str, Any]] = {
        "ppo.sigma_degrees": 3.0,
        "disc.span": 10,
        "env.velocity_time": 0.1,
    }

    gaits: Gaits = field(
        default_factory=lambda: Gaits(speeds=(0.0, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0))
    )
    """What is commanded: stops, turns and changes of speed."""
    leash: float = 1.0
    """Largest distance between the root and its target at the start of a control step,
    m."""

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[LocomotionState, Array, Array]:
        """It goes on for a while as the clip does."""
        motion = planner.first_motion(key, self.gaits, reference)
        return LocomotionState(motion), *place_character(scene, reference)

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: LocomotionState,
        body: physics.State,
    ) -> tuple[LocomotionState, physics.State]:
        """The path goes on, on its leash."""
        motion = paths.go_on(key, self.gaits, state.motion)
        root = scene.character_qpos(body.qpos)[:2]
        motion = paths.leashed(motion, root, self.leash)
        return dataclasses.replace(state, motion=motion), body

    def root_target(
        self,
        scene: physics.Scene,
        state: LocomotionState,
        start: RootTarget,
        time: Array,
    ) -> RootTarget:
        """On the path."""
        root, heading, speed = paths.path(state.motion, time)
        return RootTarget(root, speed * paths.direction(heading))

    def observe(
        self, scene: physics.Scene, state: LocomotionState, body: physics.State
    ) -> Array:
        """`seen` [6]."""
        return seen(scene, state.motion, body)

    def evaluate(
        self, scene: physics.Scene, state: LocomotionState, body: physics.State
    ) -> dict[str, Array]:
        """`numbers`."""
        return numbers(scene, state.motion, body)


def seen(scene: physics.Scene, motion: Motion, body: physics.State) -> Array:
    """The way to the path's end of this control step (m), its velocity (m/s), and cos
    and sin of its heading [6], over the ground in the character's frame."""
    origin, facing = features.local_frame(scene.character_qpos(body.qpos))
    root, heading, speed = paths.path(motion, paths.end(motion))
    ahead = paths.direction(heading)
    rows = jnp.stack([root - origin[:2], speed * ahead, ahead])
    level = jnp.pad(rows, ((0, 0), (0, 1)))
    return quat.rotate(quat.inv(facing), level)[:, :2].reshape(-1)


def numbers(
    scene: physics.Scene, motion: Motion, body: physics.State
) -> dict[str, Array]:
    """The speeds of the root and of its path over the ground (m/s), the root's along
    the path, and the distance between the two (m)."""
    root, heading, speed = paths.path(motion, paths.end(motion))
    q, qd = scene.character_qpos(body.qpos), scene.character_qvel(body.qvel)
    return {
        "speed": paths.length(qd[:2]),
        "speed_along": qd[:2] @ paths.direction(heading),
        "path_speed": speed,
        "path_distance": paths.length(q[:2] - root),
    }
