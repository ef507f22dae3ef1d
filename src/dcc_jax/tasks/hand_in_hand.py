"""Hand-in-hand running (Sec. 5.3): a partner pulls the character by its left hand.

The partner is kinematic: nothing can hold it back. Its hand and the character's are
joined by a ball joint, whose constraint force is fed to the compliance in every physics
step. The reference runs beside the partner: a planner blends loops of walking and
running by the partner's speed (`tasks.strides`), with the left arm held out to the
partner instead of swung, and the character follows it in time.

Departure: the paper learns to plan with the discriminator (Sec. 4.1) and leaves the
planner to its Appendix. With a discriminator, and an arm that swung, the characters of
this task were still falling after two seconds when 0.6 M tuples had been seen.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics, quat
from dcc_jax.character import BODIES, CONTROL_DT, load_character
from dcc_jax.env import features
from dcc_jax.env.task import Forces, Task, place_character
from dcc_jax.motion import paths, planner
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.motion.reference import References, RefState

Array = jax.Array

HAND = "left_hand"
PALM = (0.0, 0.085, 0.0)  # m, in the hand's frame
ZERO_PALM = (0.0, 0.775, 1.335)  # m, where it is in the character's zero pose
NOMINAL_HAND = (0.2, 0.42, 0.84)  # m ahead, left of the path, and up
ARM = {"left_shoulder": (-0.97, 0.24, -0.12), "left_elbow": (0.0, 0.0, -0.73)}
"""Rotation vectors, rad, that hold the left palm at NOMINAL_HAND: within 1 cm in a
stand, 4 cm in a jog or a run in the mean, with 4 cm of rocking. Arms that swung had the
hands pull with 175 N in every stand."""
SETTLING_TIME = 0.2  # s, in which the joined hands leave the reference's palm
CADENCE = 2.0 * np.pi * 2.7  # rad/s, of the steps that rock the partner's hand
RUN = 3.0  # m/s, at which they rock it in full
IMPEDANCE = 0.95  # of the joint: 1 would be rigid
TIME_CONSTANT = 0.02  # s, of the joint
LEAD = 2.0 * TIME_CONSTANT
"""s. MuJoCo takes a mocap body for resting: its joint drags on a hand that moves, as
-b v - k x with b / k = LEAD. Held that far ahead of itself, the partner's hand pulls as
-b (v - v_partner) - k (x - x_partner) would."""


@flax.struct.dataclass
class HandInHandState:
    """The partner, where the hands were joined, and what the joint bore."""

    motion: Motion
    first_hand: Array  # [3] m, where the hands were at the reset, off NOMINAL_HAND
    first_drift: Array  # [3] m/s, how fast they moved
    force_square: Array  # [] N^2 s of the joint, integrated over the control step
    force_peak: Array  # [] N, its largest force in the control step


@dataclass(frozen=True)
class HandInHand(Task):
    """Stand, walk, jog and run where the partner goes."""

    name: ClassVar[str] = "hand-in-hand"
    clips: ClassVar[tuple[str, ...]] = planner.LOOPS
    follows_reference: ClassVar[bool] = True
    conditions_on_phase: ClassVar[bool] = False
    state_size: ClassVar[int] = 8

    gaits: Gaits = field(default_factory=Gaits)
    """What the partner does."""
    bounce: float = 0.03
    """How far the partner's hand rocks up and down in a run, m; less at lower speed."""
    longest_gap: float = 0.15
    """Gap between the hands beyond which they have parted, m."""
    farthest: float = 1.2
    """Distance of the root from the path beyond which an episode ends, m."""

    def extend(self, spec: mujoco.MjSpec) -> None:
        """The partner and the ball joint between the hands."""
        # MuJoCo joins bodies where they are in the zero pose.
        body = spec.worldbody.add_body(name="partner", mocap=True, pos=ZERO_PALM)
        _add_figure(body)
        joint = spec.add_equality(
            name="hands",
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=HAND,
            name2="partner",
        )
        joint.data[:3] = PALM
        joint.solref = [TIME_CONSTANT, 1.0]
        joint.solimp = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0]

    def check_clips(self, references: References) -> None:
        """Loops of different speeds."""
        planner.strides(references)

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """Any moment of a stride at one of the partner's speeds; or a stand."""
        begins = planner.first_reference(key, references, self.gaits, begin)
        return _reaching(references.coords, begins)

    def reference(
        self,
        references: References,
        state: HandInHandState,
        at: RefState,
        elapsed: float,
    ) -> RefState:
        """Beside the partner, as it goes."""
        loops = planner.strides(references)
        later = planner.go_on(references, loops, state.motion, at, elapsed)
        return _reaching(references.coords, later)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[HandInHandState, Array, Array]:
        """The partner goes as the reference does, its hand where the reference's is."""
        motion = planner.first_motion(key, self.gaits, reference)
        before, (root, *_) = motion.position, paths.path(motion, jnp.zeros(()))
        now = paths.to_path(palm(reference.qpos), root, motion.heading)
        then = paths.to_path(palm(reference.qpos_previous), before, motion.heading)
        state = HandInHandState(
            motion=motion,
            first_hand=now - jnp.array(NOMINAL_HAND),
            first_drift=(now - then) / CONTROL_DT,
            force_square=jnp.zeros(()),
            force_peak=jnp.zeros(()),
        )
        return state, *place_character(scene, reference)

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: HandInHandState,
        body: physics.State,
    ) -> tuple[HandInHandState, physics.State]:
        """The partner goes on."""
        return dataclasses.replace(
            state,
            motion=paths.go_on(key, self.gaits, state.motion),
            force_square=jnp.zeros(()),
            force_peak=jnp.zeros(()),
        ), body

    def hand(self, state: HandInHandState, time: Array) -> tuple[Array, Array]:
        """Position [3] m and velocity [3] m/s of the partner's hand, world."""

        def position(time: Array) -> Array:
            root, heading, speed = paths.path(state.motion, time)
            rocking = self.bounce * jnp.minimum(speed / RUN, 1.0)
            offset = jnp.array(NOMINAL_HAND) + _settling(state, time)
            offset = offset.at[2].add(rocking * jnp.sin(CADENCE * time))
            return paths.from_path(offset, root, heading)

        time = jnp.asarray(time)
        return jax.jvp(position, (time,), (jnp.ones_like(time),))

    def world(
        self, scene: physics.Scene, state: HandInHandState, time: Array
    ) -> physics.World:
        """The partner, its hand `LEAD` s ahead."""
        position, velocity = self.hand(state, time)
        _, heading, _ = paths.path(state.motion, time)
        half = 0.5 * heading
        facing = jnp.stack([jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])
        return dataclasses.replace(
            physics.default_world(scene),
            mocap_pos=(position + LEAD * velocity)[None],
            mocap_quat=facing[None],
        )

    def forces(
        self,
        scene: physics.Scene,
        state: HandInHandState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[HandInHandState, Forces]:
        """The constraint force on the palm, F = 1."""
        hand = scene.body(HAND)
        reach = quat.rotate(kin.body_quat[hand], jnp.array(PALM))
        force = solution.equality_force[:3]
        square = jnp.sum(jnp.square(force))
        state = dataclasses.replace(
            state,
            force_square=state.force_square + scene.timestep * square,
            force_peak=jnp.maximum(state.force_peak, jnp.sqrt(square + 1e-12)),
        )
        return state, Forces(
            force_w=force[None],
            point_w=(kin.body_pos[hand] + reach)[None],
            body=jnp.array([hand]),
            gate=jnp.ones((), bool),
        )

    def observe(
        self, scene: physics.Scene, state: HandInHandState, body: physics.State
    ) -> Array:
        """The partner's hand, its velocity [6], and cos and sin of the way it goes."""
        origin, facing = features.local_frame(scene.character_qpos(body.qpos))
        now = paths.end(state.motion)
        position, velocity = self.hand(state, now)
        _, heading, _ = paths.path(state.motion, now)
        ahead = jnp.append(paths.direction(heading), 0.0)
        seen = jnp.stack([position - origin, velocity, ahead])
        return quat.rotate(quat.inv(facing), seen).reshape(-1)[:8]

    def terminated(
        self, scene: physics.Scene, state: HandInHandState, body: physics.State
    ) -> Array:
        """The hands have parted, or the character is dragged along."""
        numbers = self.evaluate(scene, state, body)
        parted = numbers["hand_gap"] > self.longest_gap
        return parted | (numbers["path_distance"] > self.farthest)

    def evaluate(
        self, scene: physics.Scene, state: HandInHandState, body: physics.State
    ) -> dict[str, Array]:
        """Of a control step: mean square (N^2) and peak (N) of the joint's force, gap
        between the hands and distance to the path (m), speed of the partner (m/s)."""
        q = scene.character_qpos(body.qpos)
        root, _, speed = paths.path(state.motion, paths.end(state.motion))
        hand, _ = self.hand(state, paths.end(state.motion))
        return {
            "hand_force_square": state.force_square / CONTROL_DT,
            "hand_force_peak": state.force_peak,
            "hand_gap": paths.length(palm(q) - hand),
            "path_distance": paths.length(q[:2] - root),
            "partner_speed": speed,
        }


def palm(q: Array) -> Array:
    """Where the left palm of a character with coordinates [55] is: [3] m, world."""
    positions, quats = features.body_poses(features.skeleton(), q)
    hand = BODIES.index(HAND)
    return positions[hand] + quat.rotate(quats[hand], jnp.array(PALM))


def _reaching(coords: quat.Coordinates, reference: RefState) -> RefState:
    """The same moment with the left arm held out to the partner."""
    names = load_character().joint_names
    arm = np.array([1 + names.index(name) for name in ARM])  # after the root

    def held(q: Array) -> Array:
        scalars, quats = coords.split_q(q)
        pose = quat.exp(jnp.array(list(ARM.values())))
        return coords.join_q(scalars, quats.at[arm].set(pose))

    scalars, turning = coords.split_v(reference.qvel)
    return dataclasses.replace(
        reference,
        qpos=held(reference.qpos),
        qvel=coords.join_v(scalars, turning.at[arm].set(0.0)),
        qpos_previous=held(reference.qpos_previous),
    )


def _settling(state: HandInHandState, time: Array) -> Array:
    """What is left of the hands' first offset [3] m: a critically damped return."""
    rate = 1.0 / SETTLING_TIME
    push = state.first_drift + rate * state.first_hand
    return (state.first_hand + time * push) * jnp.exp(-rate * time)


def _add_figure(body: mujoco.MjsBody) -> None:
    """What is seen of the partner, who goes to the left of the hands."""
    seen = {"contype": 0, "conaffinity": 0, "rgba": [0.80, 0.50, 0.25, 1.0]}
    shoulder, hip, side = [-0.1, 0.28, 0.42], [-0.1, 0.45, 0.0], [-0.1, 0.45]
    for name, start, end, radius in (
        ("partner_arm", [0.0, 0.0, 0.0], shoulder, 0.045),
        ("partner_trunk", hip, [*side, 0.4], 0.12),
        ("partner_leg", hip, [*side, -0.8], 0.08),
        ("partner_head", [*side, 0.66], [*side, 0.7], 0.105),
    ):
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=start + end,
            size=[radius, 0, 0],
            **seen,
        )
