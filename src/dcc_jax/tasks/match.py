"""A chicken fight of two characters in one scene, each with its own policy (Sec. 5.3).

Each is an environment of its own that was trained against the box; here they share the
physics, and each is to the other what the box was. Everything is pure
and of ONE match, as in `env.environment`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco

from dcc_jax import physics, quat
from dcc_jax.character import (
    CONTROL_DT,
    Character,
    add_contact,
    compose_scene,
    sole_names,
)
from dcc_jax.env.environment import Environment
from dcc_jax.env.state import EnvState, Substep
from dcc_jax.env.substep import physics_step
from dcc_jax.motion import paths
from dcc_jax.motion.reference import References, RefState, planar_moved
from dcc_jax.tasks.chicken_fight import (
    FRICTION,
    TARGETS,
    ChickenFight,
    ChickenFightState,
    hopping_at,
)

Array = jax.Array

RIVAL = "rival_"
"""Prefix of the second character's names."""
ROOT = "root"
REACH = 0.15  # m; the reference's root is so far ahead, towards the opponent
BUMP_TIME = 1.0  # s after its beginning a bump is over
Sides = tuple[EnvState, EnvState]


@dataclass(frozen=True)
class Fighter(ChickenFight):
    """One of two: hops towards the opponent, whoever that is."""

    def first_reference(
        self, key: Array, references: References, begin: bool
    ) -> RefState:
        """Hops ahead, where the opponent is, and never twice the same."""
        time = jax.random.uniform(key, maxval=references.duration[0])
        return hopping_at(references, time, jnp.array([max(self.gaits.speeds), 0.0]))

    def aimed(
        self, scene: physics.Scene, state: ChickenFightState, body: physics.State
    ) -> ChickenFightState:
        """The reference ahead of the root, on its way to the opponent."""
        root = scene.character_qpos(body.qpos)[:2]
        adr, _ = scene.address(self.opponent)
        way = body.qpos[adr : adr + 2] - root
        heading = jnp.arctan2(way[1], way[0])
        motion = dataclasses.replace(
            state.motion,
            position=root + REACH * paths.direction(heading),
            heading=heading,
            speed=jnp.full((), max(self.gaits.speeds)),
            acceleration=jnp.zeros(()),
            turn=jnp.zeros(()),
        )
        return dataclasses.replace(state, motion=motion)

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: ChickenFightState,
        body: physics.State,
    ) -> tuple[ChickenFightState, physics.State]:
        """Nothing but the opponent comes at it."""
        state = self.aimed(scene, state, body)
        now = state.motion.time + CONTROL_DT
        return dataclasses.replace(
            state,
            motion=dataclasses.replace(state.motion, time=now),
            coming=state.since_bump > BUMP_TIME,
            impulse=jnp.zeros(3),
            force_peak=jnp.zeros(()),
        ), body


class Match:
    """Static parts of a match; its methods are pure."""

    def __init__(
        self, first: Environment, second: Environment, *, distance: float = 1.2
    ) -> None:
        """Puts two characters into one scene.

        Args:
            first: an environment of the chicken fight, with its own character.
            second: another one; its physics rate must be that of the first.
            distance: m between the roots at the reset.

        Raises:
            ValueError: the two do not step at the same rate, or one does not hop.
        """
        rates = first.config.physics_rate, second.config.physics_rate
        if rates[0] != rates[1]:
            raise ValueError(f"both must have the same physics_rate, got {rates}")
        self.distance = distance
        self.control_steps = first.config.control_steps
        characters = first.scene.character, second.scene.character
        model = compose_scene(
            characters[0],
            timestep=first.scene.timestep,
            extend=_rival(characters[1]),
        )
        iterations = max(first.scene.newton_iterations, second.scene.newton_iterations)
        scenes = _shared(model, characters, iterations)
        gaits = _gaits(first), _gaits(second)
        self.fighters = (
            Fighter(opponent=RIVAL + ROOT, gaits=gaits[0]),
            Fighter(prefix=RIVAL, opponent=ROOT, gaits=gaits[1]),
        )
        self.sides = (
            first.elsewhere(scenes[0], self.fighters[0]),
            second.elsewhere(scenes[1], self.fighters[1]),
        )

    @property
    def scene(self) -> physics.Scene:
        """The scene, as the first character sees it."""
        return self.sides[0].scene

    def reset(self, key: Array, alpha: Array | None = None) -> Sides:
        """Two moments of the references, face to face.

        Args:
            key: consumed.
            alpha: levels of compliance [2]; None: as the two are configured.
        """
        keys = jax.random.split(key, 2)
        away = 0.5 * self.distance
        spots = ((0.0, -away), (math.pi, away))
        states = []
        for i, (side, (turn, x)) in enumerate(zip(self.sides, spots, strict=True)):
            state = side.reset(keys[i], None if alpha is None else alpha[i])
            states.append(_stood(side, state, turn, jnp.array([x, 0.0])))
        return self._sharing(states)

    def step(self, key: Array, states: Sides, actions: tuple[Array, Array]) -> Sides:
        """One control step of both.

        Args:
            key: consumed.
            states: of the two sides; their body is one and the same.
            actions: of the two sides, as `Environment.step` has them.
        """
        keys = jax.random.split(key, 2)
        begun = [
            side.begin(keys[i], states[i], actions[i])
            for i, side in enumerate(self.sides)
        ]
        inputs = [inputs for _, inputs in begun]
        sides = [side.side for side in self.sides]

        def one(carries: list[Substep], _: None) -> tuple[list[Substep], None]:
            steps = physics_step(sides, carries, inputs)
            return [carry for carry, _ in steps], None

        starts = [start for start, _ in begun]
        ends, _ = jax.lax.scan(one, starts, None, length=self.control_steps)
        first, second = (
            side.end(states[i], inputs[i], ends[i]) for i, side in enumerate(self.sides)
        )
        return first, second

    def _sharing(self, states: list[EnvState]) -> Sides:
        """The two states with one body, each aware of the other."""
        first, second = (s.scene for s in self.sides)
        mine, theirs = (state.body for state in states)
        body = physics.initial_state(
            first,
            mine.qpos.at[second.qpos_adr : second.qpos_adr + 55].set(
                second.character_qpos(theirs.qpos)
            ),
            mine.qvel + theirs.qvel,
        )
        seeing = []
        for i, side in enumerate(self.sides):
            task = self.fighters[i].aimed(side.scene, states[i].task, body)
            state = dataclasses.replace(states[i], body=body, task=task)
            seeing.append(side.observed(state))
        return seeing[0], seeing[1]


def _gaits(environment: Environment) -> paths.Gaits:
    task = environment.task
    if not isinstance(task, ChickenFight):
        raise ValueError(f"a match needs two of chicken-fight, got {task.name}")
    return task.gaits


def _rival(character: Character) -> Callable[[mujoco.MjSpec], None]:
    """Adds a second character to a scene that has one and a floor."""

    def extend(spec: mujoco.MjSpec) -> None:
        frame = spec.worldbody.add_frame()
        spec.attach(character.spec(), prefix=RIVAL, frame=frame)
        for sole in sole_names(spec):
            if sole.startswith(RIVAL):
                add_contact(spec, "floor", sole)
        for mine in TARGETS:
            for theirs in TARGETS:
                add_contact(spec, mine, RIVAL + theirs, FRICTION)

    return extend


def _shared(
    model: mujoco.MjModel, characters: tuple[Character, Character], iterations: int
) -> tuple[physics.Scene, physics.Scene]:
    """One scene, as either of its characters sees it; stable PD in both."""
    first = physics.make_scene(model, characters[0], newton_iterations=iterations)
    both = physics.make_scene(
        first.model, characters[1], root=RIVAL + ROOT, newton_iterations=iterations
    )
    second = dataclasses.replace(
        both, spd_diagonal=first.spd_diagonal + both.spd_diagonal
    )
    mine = {name: getattr(first, name) for name in ("character", "qpos_adr", "dof_adr")}
    return dataclasses.replace(second, **mine), second


def _stood(side: Environment, state: EnvState, turn: float, spot: Array) -> EnvState:
    """A state at the reset with its character turned and moved over the ground."""
    scene, body = side.scene, state.body
    angle = jnp.asarray(turn)
    about_z = quat.exp(jnp.array([0.0, 0.0, turn]))
    reference = state.reference
    here = scene.character_qpos(body.qpos)
    # It turns about the world's origin, and stands beside that already.
    spot = spot - planar_moved(here, angle, jnp.zeros(2))[:2]
    q = planar_moved(here, angle, spot)

    def turned(velocity: Array) -> Array:
        return velocity.at[:3].set(quat.rotate(about_z, velocity[:3]))

    qd = turned(scene.character_qvel(body.qvel))
    qpos = jax.lax.dynamic_update_slice(body.qpos, q, (scene.qpos_adr,))
    qvel = scene.scatter_character(qd)
    return dataclasses.replace(
        state,
        body=dataclasses.replace(body, qpos=qpos, qvel=qvel),
        q_previous=planar_moved(state.q_previous, angle, spot),
        reference=dataclasses.replace(
            reference,
            qpos=planar_moved(reference.qpos, angle, spot),
            qvel=turned(reference.qvel),
            qpos_previous=planar_moved(reference.qpos_previous, angle, spot),
            travel=quat.rotate(about_z, jnp.append(reference.travel, 0.0))[:2],
        ),
        task=dataclasses.replace(state.task, facing=angle),
    )
