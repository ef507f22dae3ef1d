"""Pushed balance (Sec. 5.2): 1 kg balls thrown at a standing character from all sides.

The forces fed to the compliance are the contacts of a ball with the character.

The ball slides along x, y and z and does not spin: its unknowns are coupled with all of
the character's, and three of them instead of six make those matrices smaller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import draws, physics
from dcc_jax.character import CONTROL_DT, GRAVITY, add_contact
from dcc_jax.env.task import Event, Forces, Task, place_character
from dcc_jax.motion.reference import RefState

Array = jax.Array

TARGETS = ("chest", "abdomen", "pelvis", "head", "left_upper_arm", "right_upper_arm")
"""Geoms a ball can hit."""
AIM_HEIGHTS = (0.75, 1.35)  # m above the ground, of the standing character
AWAY = (0.0, 0.0, -10.0)  # m, from where the ball slides, out of sight


@flax.struct.dataclass
class PushState:
    """When the next ball comes."""

    next_throw: Array  # [] s until then


@dataclass(frozen=True)
class Push(Task):
    """Stand, and step where it takes a step."""

    name: ClassVar[str] = "push"
    clips: ClassVar[tuple[str, ...]] = (
        "stand",
        "balance",
        *(f"recover_{angle:03d}" for angle in range(0, 360, 45)),
    )
    state_size: ClassVar[int] = 6
    config_overrides: ClassVar[Mapping[str, Any]] = {
        "ppo.sigma_degrees": 3.0,
        "env.turn_arm": 0.1,
        "disc.feature_floor": 0.01,
    }
    event: ClassVar[Event | None] = Event("throw a ball", "next_throw")
    clock: ClassVar[str | None] = "since_throw"

    interval: float = 1.5
    """Time between two throws, s."""
    mass: float = 1.0
    """Mass of the ball, kg (Sec. 5.2)."""
    radius: float = 0.1
    """Radius of the ball, m."""
    speed: tuple[float, float] = (2.0, 3.0)
    """Least and greatest speed of the ball at the release, m/s (Sec. 5.2)."""
    distance: float = 0.8
    """Distance of the ball from the root at the release, m."""
    floats: bool = False
    """The ball has no weight: a heavy, slow one is an obstacle that presses."""

    def quiet(self) -> Push:
        """Nobody throws."""
        return dataclasses.replace(self, interval=1e9)

    def extend(self, spec: mujoco.MjSpec) -> None:
        """A ball that touches the character's trunk, head and upper arms."""
        ball = spec.worldbody.add_body(
            name="ball", pos=list(AWAY), gravcomp=float(self.floats)
        )
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        for name, axis in zip(("ball", "ball_y", "ball_z"), np.eye(3), strict=True):
            ball.add_joint(name=name, type=slide, axis=axis)
        ball.add_geom(
            name="ball",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[self.radius, 0, 0],
            mass=self.mass,
            rgba=[0.9, 0.45, 0.1, 1.0],
            contype=0,
            conaffinity=0,
        )
        for target in TARGETS:
            add_contact(spec, "ball", target, friction=0.5)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[PushState, Array, Array]:
        """The first ball comes after a random share of the interval."""
        qpos, qvel = place_character(scene, reference)
        return PushState(self.interval * jax.random.uniform(key)), qpos, qvel

    def control_step(
        self, key: Array, scene: physics.Scene, state: PushState, body: physics.State
    ) -> tuple[PushState, physics.State]:
        """Releases the next ball when its time has come."""
        due = state.next_throw <= 0.0
        thrown = self._thrown(key, scene, body)
        body = jax.tree.map(lambda a, b: jnp.where(due, a, b), thrown, body)
        waited = jnp.where(due, self.interval, state.next_throw)
        return PushState(waited - CONTROL_DT), body

    def _thrown(
        self, key: Array, scene: physics.Scene, body: physics.State
    ) -> physics.State:
        side, height, speed = draws.uniform(
            key, (-jnp.pi, jnp.pi), AIM_HEIGHTS, self.speed
        )
        away = jnp.stack([jnp.cos(side), jnp.sin(side), jnp.zeros(())])
        root, drift = scene.character_qpos(body.qpos)[:2], _drift(scene, body)
        flight = (self.distance - self.radius - 0.1) / speed
        start = jnp.append(root, height) + self.distance * away
        # It rises by as much as gravity takes until it arrives.
        rise = 0.0 if self.floats else 0.5 * GRAVITY * flight
        velocity = -speed * away + jnp.append(drift, rise)
        q_adr, v_adr = scene.address("ball")
        return dataclasses.replace(
            body,
            qpos=body.qpos.at[q_adr : q_adr + 3].set(start - jnp.array(AWAY)),
            qvel=body.qvel.at[v_adr : v_adr + 3].set(velocity),
            qacc=body.qacc.at[v_adr : v_adr + 3].set(0.0),
        )

    def forces(
        self,
        scene: physics.Scene,
        state: PushState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[PushState, Forces]:
        """The ball's contacts with each of `TARGETS`, F = 6."""
        hit = scene.contacts([scene.body("ball")])
        return state, Forces(
            force_w=-jnp.asarray(hit.sign)[:, None]
            * solution.contact_force_w[hit.slots],
            point_w=solution.contact_point_w[hit.slots],
            body=jnp.asarray(hit.other),
            gate=jnp.ones((), bool),
        )

    def observe(
        self, scene: physics.Scene, state: PushState, body: physics.State
    ) -> Array:
        """Nothing of the ball: a push is felt, not seen. Root velocity, [6]."""
        return scene.character_qvel(body.qvel)[:6]

    def evaluate(
        self, scene: physics.Scene, state: PushState, body: physics.State
    ) -> dict[str, Array]:
        """`since_throw` s, and `speed` m/s of the root over the ground."""
        return {
            "since_throw": self.interval - state.next_throw,
            "speed": jnp.sqrt(jnp.sum(_drift(scene, body) ** 2) + 1e-12),
        }


def _drift(scene: physics.Scene, body: physics.State) -> Array:
    return scene.character_qvel(body.qvel)[:2]
