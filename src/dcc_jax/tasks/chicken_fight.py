"""Chicken fight (Sec. 5.3): hop on one leg, bump and be bumped, stay up.

In training the opponent is a box as heavy as the character that stands upright, slides
over the ground and runs into the character from any side. After a bump it lets go, and
comes again from elsewhere. Hops are followed in time, their root along a path: a loop
of hops on the spot, and what two loops, ahead and to the left, have beside it, in
proportion to the path's velocity. The contact forces with the opponent, one resultant a
body, feed the compliance. `tasks.match` lets two characters fight each other.

Departure: the paper trains with the discriminator. Hops have little in common with what
a falling body does, and 0.66 M tuples took episodes from 0.8 to 1.3 s only; the clip's
time is known here (Appendix).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import draws, physics, quat
from dcc_jax.character import CONTROL_DT, add_contact
from dcc_jax.env import features
from dcc_jax.env.task import Event, Forces, Task, place_character, resultant
from dcc_jax.motion import paths, planner
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.motion.reference import References, RefState, planar_moved

Array = jax.Array

TARGETS = (
    "chest",
    "shoulders",
    "abdomen",
    "pelvis",
    "left_upper_arm",
    "right_upper_arm",
)
"""Geoms of trunk and arms that an opponent can bump into."""
BODIES = ("pelvis", "chest", "left_upper_arm", "right_upper_arm")
"""Bodies they belong to, each with a force of its own."""
FRICTION = 0.5
HALF_SIZE = (0.15, 0.20, 0.45)  # m, of the box: a trunk's depth, width and height
BOX_HEIGHT = 1.1  # m, of its middle
LONG = 100.0  # s, since a bump that never was
FASTEST = 0.42  # m/s, of the loops that travel
STILL = 1e-3  # m/s, below which hops go nowhere


@flax.struct.dataclass
class ChickenFightState:
    """The reference's path, the opponent's next attack, and the last bump."""

    motion: Motion  # of the reference's root
    facing: Array  # [] rad, by which the clip is turned
    next_attack: Array  # [] s until then
    coming: Array  # [] bool, the attack is under way and has not touched yet
    since_bump: Array  # [] s since an attack first touched
    impulse: Array  # [3] N s on the character in the control step, world
    force_peak: Array  # [] N, largest sum of its contact forces in the control step


@dataclass(frozen=True)
class ChickenFight(Task):
    """Hop, and take a bump without falling.

    Raises:
        ValueError: speeds that no hops have.
    """

    name: ClassVar[str] = "chicken-fight"
    clips: ClassVar[tuple[str, ...]] = (
        "hop_cycle",
        "hop_ahead_cycle",
        "hop_left_cycle",
    )
    follows_reference: ClassVar[bool] = True
    state_size: ClassVar[int] = 4
    event: ClassVar[Event | None] = Event("send the box", "next_attack")
    clock: ClassVar[str | None] = "since_bump"
    config_overrides: ClassVar[Mapping[str, Any]] = {
        "ppo.sigma_degrees": 3.0,
        "env.fall_height": 0.65,
    }
    """Noise of 6 degrees throws a linear-quadratic regulator off one leg, too. Hops
    take the pelvis down to 0.84 m: what is far below is a fall, of which less is seen
    then."""

    prefix: str = ""
    """Prefix of the character's names in the scene."""
    opponent: str = "box"
    """The opponent's root joint, or the first of a box's; it starts with x and y."""
    gaits: Gaits = field(default_factory=lambda: Gaits(speeds=(0.0, 0.2, 0.4)))
    """How the reference's root moves, up to 19 cm a hop, to any side."""
    interval: float = 3.0
    """Time between two attacks, s."""
    speed: tuple[float, float] = (0.2, 0.6)
    """Least and greatest speed of the box, m/s. Hops of 0.2 m make 0.4 m/s."""
    distance: float = 1.0
    """Distance between box and root when the box sets off, m."""
    off_centre: float = 0.15
    """Largest distance beside the root that the box aims at, m: bumps also turn."""
    let_go: float = 0.3
    """Time from the first touch until the box begins to brake, s."""
    brake_time: float = 0.2
    """Time constant of the box's braking, s."""

    def __post_init__(self) -> None:
        for speed in self.gaits.speeds:
            if not 0.0 <= speed <= FASTEST:
                raise ValueError(
                    f"task.gaits.speeds must be in [0, {FASTEST}] for chicken-fight, "
                    f"got {speed}"
                )

    def quiet(self) -> ChickenFight:
        """Nobody attacks."""
        return dataclasses.replace(self, interval=1e9)

    def extend(self, spec: mujoco.MjSpec) -> None:
        """A box as heavy as the character that touches its trunk and arms."""
        mass = sum(geom.mass for geom in spec.geoms if math.isfinite(geom.mass))
        box = spec.worldbody.add_body(name="box", pos=[0.0, 0.0, BOX_HEIGHT])
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        box.add_joint(name="box", type=slide, axis=[1, 0, 0])
        box.add_joint(name="box_y", type=slide, axis=[0, 1, 0])
        box.add_joint(name="box_yaw", type=hinge, axis=[0, 0, 1])
        box.add_geom(
            name="box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=HALF_SIZE,
            mass=mass,
            rgba=[0.75, 0.35, 0.2, 1.0],
            contype=0,
            conaffinity=0,
        )
        for target in TARGETS:
            add_contact(spec, "box", target, FRICTION)

    def check_clips(self, references: References) -> None:
        """Three loops of hops that travel fast enough."""
        _speeds(references)

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """Any moment of hops at one of the speeds, to any side, or of hops on the
        spot."""
        time_key, speed_key, way_key = jax.random.split(key, 3)
        share, way = jax.random.uniform(time_key), jax.random.uniform(way_key)
        speed = jax.random.choice(speed_key, jnp.array(self.gaits.speeds))
        if begin:
            share, speed = 0.0 * share, 0.0 * speed
        travel = speed * paths.direction(2.0 * jnp.pi * way)
        return hopping_at(references, share * references.duration[0], travel)

    def reference(
        self,
        references: References,
        state: ChickenFightState,
        at: RefState,
        elapsed: float,
    ) -> RefState:
        """The hops go on, their root on its path: `qpos`, `travel` and `qvel[:2]`."""
        later = super().reference(references, state, at, elapsed)
        motion = state.motion
        position, heading, speed = paths.path(motion, motion.time + elapsed)
        travel = speed * paths.direction(heading - state.facing)
        pose = hopping(references, later.time, travel)
        return dataclasses.replace(
            later,
            qpos=planar_moved(pose, state.facing, position),
            qvel=later.qvel.at[:2].set(speed * paths.direction(heading)),
            travel=speed * paths.direction(heading),
        )

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[ChickenFightState, Array, Array]:
        """The box waits out of reach; it comes after a random share of the interval."""
        draw_key, motion_key = jax.random.split(key)
        way, wait = draws.uniform(draw_key, (-jnp.pi, jnp.pi), (0.0, self.interval))
        root, travel = reference.qpos[:2], reference.travel
        # Away from the box where it begins at rest; hops do not sway.
        motion = paths.begin(
            motion_key, self.gaits, root, travel, way + jnp.pi, slowest=STILL
        )
        state = ChickenFightState(
            motion=motion,
            facing=jnp.zeros(()),
            next_attack=wait,
            coming=jnp.zeros((), bool),
            since_bump=jnp.full((), LONG),
            impulse=jnp.zeros(3),
            force_peak=jnp.zeros(()),
        )
        qpos, qvel = place_character(scene, reference)
        adr, _ = scene.address(self.opponent)
        far = root + 2.0 * self.distance * paths.direction(way)
        return state, qpos.at[adr : adr + 2].set(far), qvel

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: ChickenFightState,
        body: physics.State,
    ) -> tuple[ChickenFightState, physics.State]:
        """The reference hops on; the box attacks when its time has come."""
        motion_key, attack_key = jax.random.split(key)
        due = state.next_attack <= 0.0
        attack = self._attack(attack_key, scene, body)
        retreat = self._retreat(scene, state, body)
        body = jax.tree.map(lambda a, b: jnp.where(due, a, b), attack, retreat)
        left = jnp.where(due, self.interval, state.next_attack)
        return dataclasses.replace(
            state,
            motion=paths.go_on(motion_key, self.gaits, state.motion),
            next_attack=left - CONTROL_DT,
            coming=due | state.coming,
            impulse=jnp.zeros(3),
            force_peak=jnp.zeros(()),
        ), body

    def _attack(
        self, key: Array, scene: physics.Scene, body: physics.State
    ) -> physics.State:
        """The box on its way to the character, one face ahead."""
        off = (-self.off_centre, self.off_centre)
        side, aim, speed = draws.uniform(key, (-jnp.pi, jnp.pi), off, self.speed)
        away = paths.direction(side)
        across = jnp.stack([-away[1], away[0]])
        root = scene.character_qpos(body.qpos)[:2]
        place = jnp.append(root + self.distance * away + aim * across, side)
        adr, dof = scene.address(self.opponent)
        return dataclasses.replace(
            body,
            qpos=body.qpos.at[adr : adr + 3].set(place),
            qvel=body.qvel.at[dof : dof + 3].set(jnp.append(-speed * away, 0.0)),
            qacc=body.qacc.at[dof : dof + 3].set(0.0),
        )

    def _retreat(
        self, scene: physics.Scene, state: ChickenFightState, body: physics.State
    ) -> physics.State:
        """The box brakes a while after it has bumped, so that it does not lean on."""
        lets_go = ~state.coming & (state.since_bump > self.let_go)
        slower = jnp.where(lets_go, math.exp(-CONTROL_DT / self.brake_time), 1.0)
        _, dof = scene.address(self.opponent)
        qvel = body.qvel.at[dof : dof + 3].multiply(slower)
        return dataclasses.replace(body, qvel=qvel)

    def forces(
        self,
        scene: physics.Scene,
        state: ChickenFightState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[ChickenFightState, Forces]:
        """The contacts of the opponent, one resultant a body, F = 4."""
        bodies = [scene.body(self.prefix + name) for name in BODIES]
        sums = [self._bump(scene, solution, body) for body in bodies]
        force = jnp.stack([f for f, _ in sums])
        total = jnp.sum(force, axis=0)
        size = jnp.sqrt(jnp.sum(jnp.square(total)) + 1e-12)
        first = state.coming & jnp.any(force != 0.0)
        later = state.since_bump + scene.timestep
        state = dataclasses.replace(
            state,
            coming=state.coming & ~first,
            since_bump=jnp.where(first, 0.0, later),
            impulse=state.impulse + scene.timestep * total,
            force_peak=jnp.maximum(state.force_peak, size),
        )
        return state, Forces(
            force_w=force,
            point_w=jnp.stack([p for _, p in sums]),
            body=jnp.array(bodies),
            gate=jnp.ones((), bool),
        )

    def _bump(
        self, scene: physics.Scene, solution: physics.Solution, body: int
    ) -> tuple[Array, Array]:
        """The opponent's force [3] on a body, and its point [3]."""
        return resultant(solution, opponent_contacts(scene, body, self.opponent))

    def observe(
        self, scene: physics.Scene, state: ChickenFightState, body: physics.State
    ) -> Array:
        """Where the opponent is and how it moves [4], relative to the character."""
        q, qd = scene.character_qpos(body.qpos), scene.character_qvel(body.qvel)
        adr, dof = scene.address(self.opponent)
        offset = body.qpos[adr : adr + 2] - q[:2]
        velocity = body.qvel[dof : dof + 2] - qd[:2]
        _, facing = features.local_frame(q)
        seen = jnp.pad(jnp.stack([offset, velocity]), ((0, 0), (0, 1)))
        return quat.rotate(quat.inv(facing), seen)[:, :2].reshape(-1)

    def evaluate(
        self, scene: physics.Scene, state: ChickenFightState, body: physics.State
    ) -> dict[str, Array]:
        """Of a control step: the opponent's impulse (N s) and largest force (N), how
        far the root is from the reference's and the opponent (m), and the time since
        the bump began (s)."""
        q = scene.character_qpos(body.qpos)
        root, _, _ = paths.path(state.motion, state.motion.time + CONTROL_DT)
        adr, _ = scene.address(self.opponent)
        return {
            "bump_impulse": _length(state.impulse),
            "bump_force_peak": state.force_peak,
            "path_distance": _length(q[:2] - root),
            "opponent_distance": _length(q[:2] - body.qpos[adr : adr + 2]),
            "since_bump": state.since_bump,
        }


def hopping(references: References, time: Array, velocity: Array) -> Array:
    """The pose [55] at a moment of hops that travel, over the origin, facing x.

    Joints and height are those on the spot, and the differences of the loops ahead and
    to the left beside them, as rotation vectors, times the velocity's share of theirs.
    Backwards and to the right they are taken the other way round.

    Args:
        references: three loops in step: on the spot, ahead and to the left.
        time: of all three, s.
        velocity: over the ground [2], m/s.
    """
    split = references.coords.split_q
    spot, *others = (split(references.qpos_at(clip, time)) for clip in range(3))
    height, turn = spot[0], jnp.zeros_like(spot[1][:, 1:])
    for share, loop in zip(velocity / _speeds(references), others, strict=True):
        height = height + share * (loop[0] - spot[0])
        turn = turn + share * quat.log(quat.mul(quat.inv(spot[1]), loop[1]))
    pose = references.coords.join_q(height, quat.mul(spot[1], quat.exp(turn)))
    return pose.at[:2].set(0.0)


def hopping_at(references: References, time: Array, velocity: Array) -> RefState:
    """The reference at a moment of such hops, over the origin."""
    now = hopping(references, time, velocity)
    before = hopping(references, time - CONTROL_DT, velocity)
    before = before.at[:2].set(-CONTROL_DT * velocity)
    return dataclasses.replace(
        references.state_at(0, time),
        qpos=now,
        qvel=planner.rate(references.coords, before, now, CONTROL_DT),
        qpos_previous=before,
        travel=velocity,
    )


@jax.ensure_compile_time_eval()
def _speeds(references: References) -> np.ndarray:
    """Of the loop ahead and of that to the left, m/s [2].

    Raises:
        ValueError: the clips are not the three loops that the task needs.
    """
    duration, shift = np.asarray(references.duration), np.asarray(references.shift)
    if not (
        len(duration) == 3
        and np.asarray(references.loop).all()
        and np.ptp(duration) < 1e-3
        and np.linalg.norm(shift[0]) < 0.02
        and min(shift[1, 0], shift[2, 1]) > 0.1
    ):
        raise ValueError(
            "env.clips must be three loops of one duration for task 'chicken-fight', "
            "hops on the spot, ahead and to the left, got "
            + ", ".join(references.names)
        )
    return np.array([shift[1, 0], shift[2, 1]]) / duration[0]


def opponent_contacts(
    scene: physics.Scene, body: int, opponent: str
) -> physics.Contacts:
    """Where a body touches the opponent, whose free joint is `opponent`."""
    model = scene.model
    rival = model.body_rootid[model.jnt_bodyid[model.joint(opponent).id]]
    return scene.contacts([body], np.flatnonzero(model.body_rootid == rival).tolist())


def _length(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)) + 1e-12)
