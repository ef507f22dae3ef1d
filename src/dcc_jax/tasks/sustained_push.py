"""Sustained pushes (Sec. 5.2): stand, walk and run while forces pull at the body.

Every now and then a force of constant direction acts on one body for a while, as wind
or a dog on a lead would. It is fed to the compliance as it is. The reference goes along
a path with stops, turns and changes of speed: a planner blends loops of walking and
running by its speed (`motion.planner`), of which the reward takes where the root should
be, Eq. (14), and the discriminator judges the motion (Sec. 4.1). The path waits for who
is left behind and gives way to who is carried off: it goes on from within `leash` of
the character. `env.imitation tracking` has the planner's pose tracked as well.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import draws, physics
from dcc_jax.character import CONTROL_DT
from dcc_jax.env.task import Event, Forces, Task, place_character
from dcc_jax.motion import paths, planner
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.motion.reference import References, RefState
from dcc_jax.tasks import locomotion

Array = jax.Array


@flax.struct.dataclass
class SustainedPushState:
    """Where the character should go, and the push that acts or comes next."""

    motion: Motion
    force_w: Array  # [3] N, zero in a pause
    target: Array  # [] int32, index into `SustainedPush.bodies`
    left: Array  # [] s of the push, or of the pause
    since: Array  # [] s since the last push began


@dataclass(frozen=True)
class SustainedPush(Task):
    """Stand, walk or run, whoever pulls."""

    name: ClassVar[str] = "sustained-push"
    clips: ClassVar[tuple[str, ...]] = planner.LOOPS
    follows_reference: ClassVar[bool] = True
    tracks: ClassVar[bool] = False
    conditions_on_phase: ClassVar[bool] = False
    state_size: ClassVar[int] = locomotion.SEEN
    event: ClassVar[Event | None] = Event("next push or pause", "left")
    clock: ClassVar[str | None] = "since_push"

    gaits: Gaits = field(default_factory=Gaits)
    """Where it should go: stops, turns and changes of speed."""

    bodies: tuple[str, ...] = ("pelvis", "chest", "head", "left_hand", "right_hand")
    """Bodies that may be pushed, at their centres of mass."""
    strength: tuple[float, float] = (20.0, 80.0)
    """Least and greatest force, N; 64 N is a tenth of the weight."""
    duration: tuple[float, float] = (1.0, 3.0)
    """Least and greatest duration of a push, s."""
    pause: tuple[float, float] = (0.5, 1.5)
    """Least and greatest pause between two pushes, s."""
    slope: float = 0.3
    """Largest angle of the force above or below the ground plane, rad."""
    leash: float = 0.8
    """Largest distance between the root and its path at the start of a control step, m.
    With a path that did not wait, most episodes ended where it was lost."""

    def quiet(self) -> SustainedPush:
        """Nobody pushes."""
        return dataclasses.replace(self, strength=(0.0, 0.0))

    def check_clips(self, references: References) -> None:
        """Loops of different speeds."""
        planner.strides(references)

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """Any moment of a stride at one of the speeds; or a stand."""
        return planner.first_reference(key, references, self.gaits, begin)

    def reference(
        self,
        references: References,
        state: SustainedPushState,
        at: RefState,
        elapsed: float,
    ) -> RefState:
        """Along the path."""
        loops = planner.strides(references)
        return planner.go_on(references, loops, state.motion, at, elapsed)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[SustainedPushState, Array, Array]:
        """It begins in a pause."""
        pause_key, motion_key = jax.random.split(key)
        state = SustainedPushState(
            motion=planner.first_motion(motion_key, self.gaits, reference),
            force_w=jnp.zeros(3),
            target=jnp.zeros((), jnp.int32),
            left=self.pause[1] * jax.random.uniform(pause_key),
            since=jnp.zeros(()),
        )
        return state, *place_character(scene, reference)

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: SustainedPushState,
        body: physics.State,
    ) -> tuple[SustainedPushState, physics.State]:
        """The path goes on; pushes and pauses take turns."""
        change_key, motion_key = jax.random.split(key)
        *push, rest = draws.uniform(
            change_key,
            (-jnp.pi, jnp.pi),
            (-self.slope, self.slope),
            self.strength,
            (0.0, len(self.bodies)),
            self.duration,
            self.pause,
        )
        over = state.left <= 0.0
        pushing = jnp.any(state.force_w != 0.0)
        changed = jax.tree.map(
            lambda a, b: jnp.where(pushing, a, b),
            dataclasses.replace(state, force_w=jnp.zeros(3), left=rest),
            self._pushing(push, state),
        )
        state = jax.tree.map(lambda a, b: jnp.where(over, a, b), changed, state)
        motion = paths.go_on(motion_key, self.gaits, state.motion)
        root = scene.character_qpos(body.qpos)[:2]
        motion = paths.leashed(motion, root, self.leash)
        return dataclasses.replace(
            state,
            motion=motion,
            left=state.left - CONTROL_DT,
            since=state.since + CONTROL_DT,
        ), body

    def _pushing(
        self, drawn: list[Array], state: SustainedPushState
    ) -> SustainedPushState:
        way, slope, size, target, left = drawn
        level = jnp.cos(slope)
        direction = jnp.stack(
            [level * jnp.cos(way), level * jnp.sin(way), jnp.sin(slope)]
        )
        return dataclasses.replace(
            state,
            force_w=size * direction,
            target=target.astype(jnp.int32),
            left=left,
            since=jnp.zeros(()),
        )

    def applied(
        self,
        scene: physics.Scene,
        state: SustainedPushState,
        kin: physics.Kinematics,
        time: Array,
    ) -> Array:
        """J^T f at the body's centre of mass."""
        body, point = self._place(scene, state, kin)
        return physics.generalized_force(
            scene, kin, point[None], body[None], state.force_w[None]
        )

    def forces(
        self,
        scene: physics.Scene,
        state: SustainedPushState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[SustainedPushState, Forces]:
        """The push itself, F = 1."""
        body, point = self._place(scene, state, kin)
        return state, Forces(
            force_w=state.force_w[None],
            point_w=point[None],
            body=body[None],
            gate=jnp.ones((), bool),
        )

    def _place(
        self, scene: physics.Scene, state: SustainedPushState, kin: physics.Kinematics
    ) -> tuple[Array, Array]:
        """The body pushed [] and its centre of mass [3]."""
        body = jnp.array([scene.body(name) for name in self.bodies])[state.target]
        return body, kin.body_center[body]

    def observe(
        self, scene: physics.Scene, state: SustainedPushState, body: physics.State
    ) -> Array:
        """The path ahead, as `locomotion.seen` [6]. The push is felt, not seen."""
        return locomotion.seen(scene, state.motion, body)

    def evaluate(
        self, scene: physics.Scene, state: SustainedPushState, body: physics.State
    ) -> dict[str, Array]:
        """The push (N), the time since the last one began (s), `locomotion.numbers`."""
        return {
            "push": paths.length(state.force_w),
            **locomotion.numbers(scene, state.motion, body),
            "since_push": state.since,
        }
