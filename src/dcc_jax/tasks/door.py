"""Opening a door (Sec. 5.4): reach for the knob, push while stepping through, let go.

The door swings about a vertical hinge at its right edge, away from the character. While
the hand holds the knob the two are joined; the share of the joining force that is
orthogonal to the knob's circle is fed to the compliance, the share along it opens the
door. The controller follows its clip in time, which says when to grasp.

Departure: a ball joint, not the paper's joint without freedom. A fist turns on a knob,
and a hand that is up to 5 cm away is drawn in without its orientation being forced.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT, CONTROL_RATE
from dcc_jax.env import features
from dcc_jax.env.task import Forces, Task, place_character
from dcc_jax.motion.reference import RefState

Array = jax.Array

KNOB = (0.46, -0.06, 1.0)  # m, of the closed door, in the clip's own coordinates
PALM = (0.0, -0.085, 0.0)  # m, in the frame of the right hand
HAND = "right_hand"
GRASP_TIME, RELEASE_TIME = 1.2, 4.0  # s into the clip; the hand may hold in between
OPENING = 0.9  # rad, where the clip leaves the door
TARGET_ANGLE = 0.7  # rad, from which on the door counts as open (Sec. 5.4)

CLOSING_TIME = 0.04  # s, in which the hand closes on the knob
HEIGHT, THICKNESS = 2.0, 0.04  # m
EDGE = 0.08  # m of door beyond the knob
STANDOFF = 0.07  # m from the knob to the middle of the door
LARGEST_ANGLE = 2.0  # rad, where a stop ends the swing


@flax.struct.dataclass
class DoorState:
    """The grip and the forces in it."""

    time: Array  # [] s into the clip
    holding: Array  # [] bool, whether hand and knob are joined
    orthogonal: Array  # [] N, to the knob's path; mean size over the control step
    parallel: Array  # [] N, along it, positive where it opens the door; mean likewise


@dataclass(frozen=True)
class Door(Task):
    """Open a door and let go of it.

    Raises:
        ValueError: a width, density or damping that makes no door.
    """

    name: ClassVar[str] = "door"
    clips: ClassVar[tuple[str, ...]] = ("door",)
    has_reward: ClassVar[bool] = True
    follows_reference: ClassVar[bool] = True
    start_radius: ClassVar[float] = 0.02
    state_size: ClassVar[int] = 7
    adjustable: ClassVar[Mapping[str, tuple[float, float]]] = {"width": (0.8, 1.8)}
    camera_azimuth: ClassVar[float] = 20.0  # the door hides what is behind it

    width: float = 1.0
    """Distance from hinge to knob, m; evaluated from 1.0 to 1.7 (Sec. 5.4)."""
    density: float = 12.0
    """Mass of the door per area, kg/m^2: 0.9 m wide, as a solid inner door."""
    damping: float = 10.0
    """Damping of the hinge, N m s/rad."""
    reach: float = 0.05
    """Distance from palm to knob within which the hand takes hold, m."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < math.inf:
                raise ValueError(f"task.{name} must be positive, got {value}")

    @property
    def hinge(self) -> tuple[float, float]:
        """m, where the hinge stands on the ground."""
        return KNOB[0], KNOB[1] - self.width

    def extend(self, spec: mujoco.MjSpec) -> None:
        """The door on its post, the knob, and the joint of hand and knob."""
        post = spec.worldbody.add_geom(
            name="post",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.03, HEIGHT / 2 + 0.02, 0],
            pos=[*self.hinge, HEIGHT / 2 + 0.02],
            rgba=[0.35, 0.30, 0.26, 1.0],
        )
        door = spec.worldbody.add_body(name="door", pos=[*self.hinge, 0.0])
        hinge = door.add_joint(
            name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, -1]
        )
        hinge.damping = np.array([self.damping, 0, 0])
        hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        hinge.range = [0.0, LARGEST_ANGLE]
        span = self.width + EDGE
        panel = door.add_geom(
            name="door",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[THICKNESS / 2, span / 2, HEIGHT / 2],
            pos=[STANDOFF, span / 2, HEIGHT / 2 + 0.02],
            mass=self.density * span * HEIGHT,
            rgba=[0.62, 0.46, 0.32, 1.0],
        )
        knob = door.add_geom(
            name="knob",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0.0, self.width, KNOB[2], STANDOFF, self.width, KNOB[2]],
            size=[0.02, 0, 0],
            mass=0.0,
            rgba=[0.75, 0.68, 0.35, 1.0],
        )
        for geom in (post, panel, knob):
            geom.contype, geom.conaffinity = 0, 0
        door.add_site(name="knob", pos=[0.0, self.width, KNOB[2]])
        spec.body(HAND).add_site(name="palm", pos=list(PALM))
        grip = spec.add_equality(
            name="grip",
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1="palm",
            name2="knob",
            active=False,
        )
        grip.solref = [CLOSING_TIME, 1.0]

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[DoorState, Array, Array]:
        """The door as wide open as the moment of the clip has it, hand on knob."""
        qpos, qvel = place_character(scene, reference)
        angle, rate = self._angle_at(reference)
        q_adr, v_adr = scene.address("hinge")
        time = reference.time
        state = DoorState(
            time=time,
            holding=(time >= GRASP_TIME) & (time < RELEASE_TIME),
            orthogonal=jnp.zeros(()),
            parallel=jnp.zeros(()),
        )
        return state, qpos.at[q_adr].set(angle), qvel.at[v_adr].set(rate)

    def _angle_at(self, reference: RefState) -> tuple[Array, Array]:
        """Angle of the door in rad and its rate, as the clip's palm leads it."""
        now, before = (
            self._bearing(_palm(q)) for q in (reference.qpos, reference.qpos_previous)
        )
        time = reference.time
        held = (time >= GRASP_TIME) & (time < RELEASE_TIME)
        after = jnp.where(time < GRASP_TIME, 0.0, OPENING)
        rate = CONTROL_RATE * (now - before)
        return jnp.where(held, now, after), jnp.where(held, rate, 0.0)

    def _bearing(self, point_w: Array) -> Array:
        """Angle of the door that points at a point [3], rad."""
        away = point_w[:2] - jnp.asarray(self.hinge)
        return jnp.maximum(jnp.arctan2(away[0], away[1]), 0.0)

    def control_step(
        self, key: Array, scene: physics.Scene, state: DoorState, body: physics.State
    ) -> tuple[DoorState, physics.State]:
        """The clip goes on; the forces are noted anew."""
        zero = jnp.zeros(())
        state = dataclasses.replace(
            state, time=state.time + CONTROL_DT, orthogonal=zero, parallel=zero
        )
        return state, body

    def world(
        self, scene: physics.Scene, state: DoorState, time: Array
    ) -> physics.World:
        """Hand and knob are joined while the hand holds."""
        world = physics.default_world(scene)
        return dataclasses.replace(world, equality_active=state.holding[None])

    def forces(
        self,
        scene: physics.Scene,
        state: DoorState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[DoorState, Forces]:
        """What of the knob's force is orthogonal to its path, F = 1."""
        hand, door = scene.body(HAND), scene.body("door")
        palm = _point(kin, hand, PALM)
        knob = _point(kin, door, (0.0, self.width, KNOB[2]))
        path = quat.rotate(kin.body_quat[door], jnp.array([1.0, 0.0, 0.0]))
        force = solution.equality_force[:3]
        along = force @ path
        orthogonal = force - along * path
        share = CONTROL_RATE * scene.timestep
        near = jnp.sum(jnp.square(palm - knob)) < self.reach**2
        due = (state.time >= GRASP_TIME) & (state.time < RELEASE_TIME)
        noted = dataclasses.replace(
            state,
            holding=due & (state.holding | near),
            orthogonal=state.orthogonal + share * _norm(orthogonal),
            parallel=state.parallel - share * along,
        )
        return noted, Forces(
            force_w=orthogonal[None],
            point_w=palm[None],
            body=jnp.asarray([hand]),
            gate=state.holding,
        )

    def observe(
        self, scene: physics.Scene, state: DoorState, body: physics.State
    ) -> Array:
        """Angle, grip, knob in the hand's frame [3], the way through the door [2]."""
        q = scene.character_qpos(body.qpos)
        angle = body.qpos[scene.address("hinge")[0]]
        circle = self.width * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        knob = jnp.append(jnp.asarray(self.hinge) + circle, KNOB[2])
        hand_w, turn_w = features.body_pose(q, HAND)
        _, heading = features.local_frame(q)
        through = quat.rotate(quat.inv(heading), jnp.array([1.0, 0.0, 0.0]))
        return jnp.concatenate(
            [
                angle[None],
                state.holding[None].astype(q.dtype),
                quat.rotate(quat.inv(turn_w), knob - hand_w),
                through[:2],
            ]
        )

    def reward(
        self, scene: physics.Scene, state: DoorState, body: physics.State
    ) -> Array:
        """r_task = exp(-1.5 max(0, 0.7 - angle))."""
        angle = body.qpos[scene.address("hinge")[0]]
        return jnp.exp(-1.5 * jnp.maximum(0.0, TARGET_ANGLE - angle))

    def evaluate(
        self, scene: physics.Scene, state: DoorState, body: physics.State
    ) -> dict[str, Array]:
        """Angle in rad, whether that is open; while the hand holds, the forces in N."""
        angle = body.qpos[scene.address("hinge")[0]]
        return {
            "angle": angle,
            "open": angle >= TARGET_ANGLE,
            "holding": state.holding,
            "orthogonal_force": jnp.where(state.holding, state.orthogonal, jnp.nan),
            "parallel_force": jnp.where(state.holding, state.parallel, jnp.nan),
        }


def _palm(q: Array) -> Array:
    """Position [3] of the palm at the character's coordinates [55]."""
    pos_w, quat_w = features.body_pose(q, HAND)
    return pos_w + quat.rotate(quat_w, jnp.asarray(PALM))


def _point(
    kin: physics.Kinematics, body: int, offset: tuple[float, float, float]
) -> Array:
    """World position [3] of a point of a body."""
    return kin.body_pos[body] + quat.rotate(kin.body_quat[body], jnp.asarray(offset))


def _norm(v: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(v)) + 1e-12)
