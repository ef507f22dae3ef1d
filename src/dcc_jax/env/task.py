"""What a task is: a scene and a few pure functions of ONE environment.

A task is a frozen dataclass that derives from `Task` and overrides what it needs; the
defaults describe a character alone on the floor. `docs/tasks.md` walks through one.
Letters: F forces passed to the compliance controller, S numbers of the task's own
state vector.
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

from dcc_jax import physics
from dcc_jax.motion.reference import References, RefState

Array = jax.Array


@flax.struct.dataclass
class Forces:
    """External forces for the compliance controller, F a task's own number."""

    force_w: Array  # [F, 3] N, world, on the character; exactly zero: none acts
    point_w: Array  # [F, 3] m, where it acts
    body: Array  # [F] int32, id of the character's body in the scene
    gate: Array  # [] bool; False: none of them is passed to the controller


@dataclass(frozen=True)
class Event:
    """What happens by itself now and then. In the viewer it waits, or comes at once."""

    name: str  # of the viewer's button
    countdown: str  # field of the task's state: s until it happens


@flax.struct.dataclass
class RootTarget:
    """Where the reference's root is over the ground, and how fast it moves."""

    position: Array  # [2] m, world
    velocity: Array  # [2] m/s


@flax.struct.dataclass
class Nothing:
    """The state of a task that has none."""


@dataclass(frozen=True)
class Task:
    """The contract. `scene` is static; `state` is the task's own pytree."""

    name: ClassVar[str] = ""
    clips: ClassVar[tuple[str, ...]] = ("stand",)
    """Assets in `assets/motions` that a fresh install trains on."""
    has_reward: ClassVar[bool] = False
    follows_reference: ClassVar[bool] = False
    """Whether the reference goes on in time (Sec. 5.4 and Appendix): the root's target
    and the world are where `reference` has them. `env.imitation` says whether its pose
    is tracked as well, or the discriminator judges."""
    tracks: ClassVar[bool] = True
    """Of a reference that goes on in time: whether its pose is tracked unless
    `env.imitation` says otherwise."""
    trackable: ClassVar[bool] = True
    """Whether `env.imitation tracking` makes sense: clips or planner have a pose for
    every moment of the task."""
    conditions_on_phase: ClassVar[bool] = True
    """Whether the discriminator, and the policy with it, are given the phase of a
    reference that goes on in time; not where a planner makes it."""
    pd_yields: ClassVar[bool] = True
    """Whether PD gives way to the task's `forces` from where the clips have the pose.
    Not to forces that the clips show already, such as those that a landing makes."""
    start_radius: ClassVar[float] = 0.0
    """m in x and y, how far beside such a clip an episode may begin."""
    extra_actions: ClassVar[int] = 0
    state_size: ClassVar[int] = 0
    clock: ClassVar[str | None] = None
    """The entry of `evaluate`, in s since an event (a throw, a landing), over which an
    evaluation draws its curves; None: over the time since the reset."""
    event: ClassVar[Event | None] = None
    """What the task lets happen by itself, where a person may have it happen."""
    adjustable: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Parameters that the viewer can change, and their ranges."""
    config_overrides: ClassVar[Mapping[str, Any]] = {}
    """What it learns with, by dotted name as on the command line, where the presets
    `cpu` and `gpu` would say otherwise: `{"ppo.sigma_degrees": 3.0}`."""
    camera_azimuth: ClassVar[float] = 130.0
    """Degrees, where pictures look: 90 is along +y, 180 along -x."""
    camera_distance: ClassVar[float] = 3.4
    """m, from how far."""
    camera_height: ClassVar[float] = 0.85
    """m above the ground, of the point they look at."""

    def extend(self, spec: mujoco.MjSpec) -> None:
        """Adds bodies and contact pairs to the scene of character and floor."""

    @property
    def has_floor(self) -> bool:
        """Whether the soles stand on the ground plane."""
        return True

    def quiet(self) -> Task:
        """The same without disturbances at random; itself where it has none."""
        return self

    def check_clips(self, references: References) -> None:
        """Nothing, where the clips suit the task.

        Raises:
            ValueError: they do not.
        """
        del references

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """The moment of the reference at which an episode begins.

        Args:
            key: consumed.
            references: the clips.
            begin: at the start of a clip instead of anywhere in it.
        """
        return references.sample(key, begin=begin)

    def reference(
        self, references: References, state: Any, at: RefState, elapsed: float
    ) -> RefState:
        """The reference `elapsed` s after `at`, where it is followed in time.

        Here its clip goes on. A task may have a planner instead (Sec. 4.1, Appendix).
        """
        return references.state_at(at.clip, at.time + elapsed)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[Any, Array, Array]:
        """The task's state, and qpos [nq] and qvel [nv] of the whole scene."""
        return Nothing(), *place_character(scene, reference)

    def control_step(
        self, key: Array, scene: physics.Scene, state: Any, body: physics.State
    ) -> tuple[Any, physics.State]:
        """What happens once a control step, before the physics: throws, schedules."""
        return state, body

    def root_target(
        self, scene: physics.Scene, state: Any, start: RootTarget, time: Array
    ) -> RootTarget:
        """The reference's root at a moment, which r_p compares with (Eq. (14)).

        Here: where the episode began, going on at the mean velocity of its clip where
        that is a loop that travels, such as a walk; at rest with every other clip.

        Args:
            scene: static.
            state: the task's own.
            start: at the reset, the mean velocity of a loop with it.
            time: s since the reset.
        """
        return dataclasses.replace(
            start, position=start.position + time * start.velocity
        )

    def applied(
        self, scene: physics.Scene, state: Any, kin: physics.Kinematics, time: Array
    ) -> Array:
        """Generalized forces of the surroundings on the scene [nv], every substep."""
        return jnp.zeros(scene.model.nv)

    def world(self, scene: physics.Scene, state: Any, time: Array) -> Any:
        """Kinematic bodies and switches at a moment, or None: as the model has them."""
        return None

    def forces(
        self,
        scene: physics.Scene,
        state: Any,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[Any, Forces]:
        """The forces of a substep for the compliance controller; may note events.

        Here: none, one row of zeros at the root.
        """
        root = scene.body(scene.character.body_names[0])
        return state, Forces(
            force_w=jnp.zeros((1, 3)),
            point_w=kin.body_center[root][None],
            body=jnp.array([root], jnp.int32),
            gate=jnp.zeros((), bool),
        )

    def observe(self, scene: physics.Scene, state: Any, body: physics.State) -> Array:
        """s_task [S], in the character's local frame."""
        return jnp.zeros(0)

    def reward(self, scene: physics.Scene, state: Any, body: physics.State) -> Array:
        """r_task, where the task has one."""
        return jnp.zeros(())

    def terminated(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> Array:
        """The task's own failure, beside falling."""
        return jnp.zeros((), bool)

    def ground_height(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> Array:
        """Height in m of what the character stands on, for the fall test."""
        return jnp.zeros(())

    def evaluate(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> dict[str, Array]:
        """The task's own numbers [] at the end of a control step, by name.

        `dcc_jax.evaluate` reduces each over an episode to `<name>/mean`, `/min`, `/max`
        and `/final`. What has to be measured at the physics rate is noted in the state
        by `forces`. Booleans become shares of the time.
        """
        return {}


def place_character(scene: physics.Scene, reference: RefState) -> tuple[Array, Array]:
    """qpos and qvel of the scene at rest with the character at a reference state."""
    qpos = jnp.asarray(scene.model.qpos0, jnp.float32)
    qpos = jax.lax.dynamic_update_slice(qpos, reference.qpos, (scene.qpos_adr,))
    return qpos, scene.scatter_character(reference.qvel)


def resultant(
    solution: physics.Solution, contacts: physics.Contacts
) -> tuple[Array, Array]:
    """The force [3] of contacts on one body, N, and its point [3], m, world.

    The point is the centre of pressure: the mean of the points, weighted by |f|.
    """
    sign = jnp.asarray(contacts.sign)[:, None]
    force_w = sign * solution.contact_force_w[contacts.slots]
    point_w = solution.contact_point_w[contacts.slots]
    size = jnp.sqrt(jnp.sum(force_w * force_w, axis=-1) + 1e-12)
    weight = size / jnp.sum(size)
    return force_w.sum(axis=0), jnp.sum(weight[:, None] * point_w, axis=0)
