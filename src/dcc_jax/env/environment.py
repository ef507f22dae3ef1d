"""One environment: a task, a character and its reference, step by step.

A control step is `control_steps` physics steps (`env.substep`), then the state (Sec.
4.2), the positional and the task reward (Eq. (14)), and whether the episode ends. It
knows no task and no discriminator; both come from outside.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT, Character, compose_scene
from dcc_jax.control import compliance
from dcc_jax.env import (
    expert,
    features,
    mechanics,
    metrics,
    observation,
    outcome,
    pairs,
    rewards,
)
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.mechanics import Mechanics
from dcc_jax.env.state import ControlInputs, EnvState, Substep, terminate_on_nonfinite
from dcc_jax.env.substep import Side, physics_step
from dcc_jax.env.task import Forces, RootTarget, Task
from dcc_jax.motion.paths import whole_steps
from dcc_jax.motion.reference import References, RefState

Array = jax.Array


class Environment:
    """Static parts of one task's environment; its methods are pure.

    Raises:
        ValueError: measured velocities where no reference is tracked, or tracking of a
            task that has none.
    """

    def __init__(
        self,
        task: Task,
        character: Character,
        references: References,
        config: EnvConfig,
    ) -> None:
        self.task = task
        self.imitation = imitation(task, config)
        self.tracks_reference = self.imitation == "tracking"
        self.follows_reference = follows_reference(task, config)
        self.has_phase = self.tracks_reference or (
            self.follows_reference and task.conditions_on_phase
        )
        self.has_pose = self.tracks_reference and config.observe_reference
        conditioned = self.has_phase and not self.tracks_reference
        self.condition_size = observation.PHASE_SIZE if conditioned else 0
        self.config = config
        self.references = references
        self._check()
        model = compose_scene(
            character,
            timestep=1.0 / config.physics_rate,
            floor=task.has_floor,
            extend=task.extend,
        )
        self.scene = physics.make_scene(
            model, character, newton_iterations=config.newton_iterations
        )
        self.mechanics = Mechanics.of(character)
        self.kinematics = self.mechanics.kinematics
        self.nominal = jax.jit(expert.nominal_pose)(references)
        self.controller = compliance.Controller.of(
            config.compliance, character, self.kinematics.coords, self.scene.timestep
        )
        self.fallen = outcome.FallTest.of(config, references)
        self.expert_lead = expert.lead(character, CONTROL_DT)
        self.action_size = character.num_joint_dofs + task.extra_actions
        self.observation_size = observation.size(task, self.has_phase, self.has_pose)
        self.feature_size = pairs.SEEN_SIZE
        self.weights = pairs.Weights(config.velocity_time, config.turn_arm)
        self.has_task_reward = task.has_reward
        # Traced once, however many programs have it.
        self._reset = jax.jit(self._begun)

    def elsewhere(self, scene: physics.Scene, task: Task) -> Environment:
        """The same in another scene, with a task for it."""
        other = copy.copy(self)
        other.scene, other.task = scene, task
        other._reset = jax.jit(other._begun)
        return other

    def reset(self, key: Array, alpha: Array | None = None) -> EnvState:
        """A new episode at a moment of the reference (Reference State Initialization).

        Args:
            key: consumed.
            alpha: level of compliance; None draws what the configuration says.
        """
        return self._reset(key, alpha)

    def _begun(self, key: Array, alpha: Array | None) -> EnvState:
        reference_key, place_key, task_key, alpha_key = jax.random.split(key, 4)
        reference, start = self._drawn(reference_key, place_key)
        task, qpos, qvel = self.task.reset(task_key, self.scene, start)
        body = physics.initial_state(self.scene, qpos, qvel)
        displacement = compliance.at_rest(self.kinematics.coords)
        zero = jnp.zeros(())
        state = EnvState(
            obs=jnp.zeros(self.observation_size),
            features=jnp.zeros(self.feature_size),
            previous_features=jnp.zeros(self.feature_size),
            condition=jnp.zeros(self.condition_size),
            r_q=zero,
            r_p=zero,
            r_task=zero,
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            nan=jnp.zeros((), bool),
            metrics=metrics.no_metrics(),
            body=body,
            displacement=displacement,
            u_previous=displacement.u,
            ground_previous=zero,
            yield_previous=displacement.u,
            q_previous=start.qpos_previous,
            start=RootTarget(start.qpos[:2], start.travel),
            reference=reference,
            alpha=self._alpha(alpha_key) if alpha is None else jnp.asarray(alpha),
            time=zero,
            task=task,
        )
        state = dataclasses.replace(state, ground_previous=self._ground(state))
        return self.observed(state)

    def step(self, key: Array, state: EnvState, action: Array) -> EnvState:
        """One control step.

        Args:
            key: consumed; what the surroundings draw.
            state: of this environment.
            action: rotation vectors of the 12 joints [36], rad, from the clip's pose
                where it is followed in time, else from the nominal pose; then the
                task's extra actions.
        """
        return self._step(key, state, action, record=False)[0]

    def recorded_step(
        self, key: Array, state: EnvState, action: Array
    ) -> tuple[EnvState, Forces]:
        """`step`, and the forces of its physics steps, leaves [substeps, ...]."""
        return self._step(key, state, action, record=True)

    def _step(
        self, key: Array, state: EnvState, action: Array, record: bool
    ) -> tuple[EnvState, Any]:
        def one(carry: Substep, _: None) -> tuple[Substep, Forces | None]:
            ((carry, forces),) = physics_step([self.side], [carry], [inputs])
            return carry, forces if record else None

        start, inputs = self.begin(key, state, action)
        steps = self.config.control_steps
        end, forces = jax.lax.scan(one, start, None, length=steps)
        return self.end(state, inputs, end), forces

    @property
    def side(self) -> Side:
        """What a physics step needs of this environment."""
        return Side(
            self.scene,
            self.task,
            self.kinematics,
            self.controller,
            self.config.displace_target,
        )

    def begin(
        self, key: Array, state: EnvState, action: Array
    ) -> tuple[Substep, ControlInputs]:
        """The beginning of a control step."""
        task, body = self.task.control_step(key, self.scene, state.task, state.body)
        reference = self._following(state.reference, task)
        pose = self._target_pose(reference, action)
        sums = metrics.no_sums(state.alpha)
        start = Substep(body, state.displacement, task, state.time, sums)
        q_m = reference.qpos if self.tracks_reference else pose
        room = self.controller.room(q_m)
        return start, ControlInputs(
            action, pose, state.alpha, room, state.reference, reference, state.time
        )

    def end(self, state: EnvState, inputs: ControlInputs, end: Substep) -> EnvState:
        """The state after a control step, by that before it and its last substep."""
        new = dataclasses.replace(
            state,
            body=end.body,
            displacement=end.displacement,
            task=end.task,
            time=whole_steps(end.time),
            reference=inputs.reference,
            q_previous=self.scene.character_qpos(state.body.qpos),
            u_previous=state.displacement.u,
            ground_previous=self._ground(state),
            yield_previous=self.yielded(state.displacement),
            previous_features=state.features,
            metrics=metrics.metrics(
                end.sums,
                self.config.control_steps,
                self.kinematics.coords,
                end.displacement.u,
                self.yielded(end.displacement),
                inputs.room,
            ),
        )
        return terminate_on_nonfinite(self._judged(self.observed(new)), state)

    def expert_pairs(self, key: Array, spans: Array) -> tuple[Array, Array, Array]:
        """(s, s') ~ M, `spans` [n] control steps apart: what the discriminator sees
        [n, 272] twice, and the condition [n, C]."""
        s, s_next, phase = expert.pairs(
            self.mechanics, self.references, key, spans, self.weights
        )
        condition = jax.vmap(observation.of_phase)(phase)
        return s, s_next, condition[:, : self.condition_size]

    def expert_action(self, state: EnvState) -> Array:
        """What leads on along the clips from where an episode begins: action [A]."""
        task, at = self.task, state.reference
        ahead = task.reference(self.references, state.task, at, self.expert_lead)
        tracks = self.tracks_reference
        base = self._following(at, state.task).qpos if tracks else self.nominal
        turn = expert.action(self.kinematics, base, ahead.qpos)
        return jnp.pad(turn, (0, task.extra_actions))

    def style_coordinates(self, s: Array, s_next: Array) -> Array:
        """Pairs of what is seen [..., 272] as points [..., 225] in m."""
        return pairs.pair_coordinates(s, s_next, self.weights)

    def _drawn(self, key: Array, place_key: Array) -> tuple[RefState, RefState]:
        """The moment of the reference an episode begins at, and the start beside it."""
        begin = not self.config.random_start
        reference = self.task.first_reference(key, self.references, begin)
        if not self.follows_reference:
            reference = _at_origin(reference)
            return reference, reference
        radius = self.task.start_radius
        away = jax.random.uniform(place_key, (2,), minval=-radius, maxval=radius)
        return reference, _moved(reference, away)

    def _following(self, reference: RefState, task: Any) -> RefState:
        """The reference a control step later, where it is followed in time."""
        if not self.follows_reference:
            return reference
        return self.task.reference(self.references, task, reference, CONTROL_DT)

    def _alpha(self, key: Array) -> Array:
        low, high = self.config.alpha, self.config.alpha_max
        if high is None:
            return jnp.asarray(low)
        return jax.random.uniform(key, minval=low, maxval=high)

    def _target_pose(self, reference: RefState, action: Array) -> Array:
        """What the policy asks for [55]: a (+) from the clip's pose or the nominal."""
        pose = reference.qpos if self.tracks_reference else self.nominal
        tangent = jnp.concatenate(
            [jnp.zeros(6, action.dtype), action[: Character.num_joint_dofs]]
        )
        coords = self.kinematics.coords
        return quat.oplus(coords, pose, quat.exp_map(coords, tangent))

    def yielded(self, displacement: compliance.Displacement) -> Array:
        """Where forces have the pose, relative to where clips have it [55].

        Both rewards take it off before they compare a pose with clips.
        Departure: the paper takes u off. Of a pose without u alone, what PD gives way
        by is no part of any clip, and a policy that works against it would be paid: it
        made the hands twice as stiff as Eq. (7) says (`evaluate --drag`).
        """
        if self.task.pd_yields:
            return compliance.whole_yield(self.controller, displacement)
        return displacement.u

    def observed(self, state: EnvState) -> EnvState:
        """Fills in the features and the observation.

        Departure: heights that the discriminator sees are above what the character
        stands on, which in clips is the floor.
        """
        obs = observation.observation(
            self.task,
            self.scene,
            self.kinematics,
            state,
            self._root_target(state),
            self.has_phase,
            self._pose_ahead(state),
        )
        q = self.scene.character_qpos(state.body.qpos).at[2].add(-self._ground(state))
        before = state.q_previous.at[2].add(-state.ground_previous)
        bodies = features.unyielded(
            self.kinematics,
            q,
            before,
            self.yielded(state.displacement),
            state.yield_previous,
        )
        # Soles must not slide, however far the pose gives way: q, not q (-) u.
        sliding = mechanics.sliding(self.mechanics, q, before)
        seen = pairs.seen(bodies, sliding, self.weights)
        first = state.time == 0.0
        return dataclasses.replace(
            state,
            obs=obs,
            features=seen,
            condition=observation.of_phase(state.reference.phase)[
                : self.condition_size
            ],
            previous_features=jnp.where(first, seen, state.previous_features),
        )

    def _pose_ahead(self, state: EnvState) -> Array:
        """What the policy observes of the pose to track, one control step ahead."""
        if not self.has_pose:
            return jnp.zeros(0)
        ahead = self._following(state.reference, state.task)
        q = self.scene.character_qpos(state.body.qpos)
        return observation.of_pose(self.kinematics, q, ahead.qpos, self.nominal)

    def _ground(self, state: EnvState) -> Array:
        return self.task.ground_height(self.scene, state.task, state.body)

    def _judged(self, state: EnvState) -> EnvState:
        """Fills in rewards and endings."""
        scene, task, config = self.scene, self.task, self.config
        q = scene.character_qpos(state.body.qpos)
        qd = scene.character_qvel(state.body.qvel)
        target = self._root_target(state)
        ground = self._ground(state)
        r_q, over = jnp.zeros(()), state.time >= config.episode_seconds - 1e-4
        if self.tracks_reference:
            r_q = outcome.tracking(
                self.kinematics,
                q,
                self.yielded(state.displacement),
                state.reference.qpos,
                config.reward,
            )
        if self.follows_reference:
            over |= outcome.clip_ended(self.references, state.reference)
        return dataclasses.replace(
            state,
            r_q=r_q,
            r_p=rewards.position_reward(
                q[:2] - target.position,
                qd[:2] - target.velocity,
                state.displacement.u[:2],
                state.displacement.ud[:2],
                config.reward,
            ),
            r_task=task.reward(scene, state.task, state.body),
            terminated=self.fallen(self.kinematics, q, ground)
            | task.terminated(scene, state.task, state.body),
            truncated=over,
        )

    def _root_target(self, state: EnvState) -> RootTarget:
        at = state.reference
        if self.tracks_reference:
            return RootTarget(at.qpos[:2], at.qvel[:2])
        if self.follows_reference:
            # When to sway is its own affair.
            return RootTarget(at.qpos[:2] - at.sway, at.qvel[:2] - at.sway_velocity)
        return self.task.root_target(self.scene, state.task, state.start, state.time)

    def _check(self) -> None:
        self.task.check_clips(self.references)
        if self.tracks_reference and not self.task.trackable:
            raise ValueError(
                "env.imitation must be 'adversarial' for task "
                f"{self.task.name!r}, which has no pose to track, got 'tracking'"
            )
        if self.config.compliance.law == "measured" and not self.tracks_reference:
            raise ValueError(
                "env.compliance.law must be 'algorithm_1' or 'admittance' for task "
                f"{self.task.name!r}, which tracks no reference, got 'measured'"
            )


def imitation(task: Task, config: EnvConfig) -> str:
    """`adversarial` or `tracking`: what r_q is with a task and a configuration."""
    if config.imitation != "task":
        return config.imitation
    tracks = task.follows_reference and task.tracks
    return "tracking" if tracks else "adversarial"


def follows_reference(task: Task, config: EnvConfig) -> bool:
    """Whether the reference goes on in time with a task and a configuration."""
    return task.follows_reference or imitation(task, config) == "tracking"


def _at_origin(reference: RefState) -> RefState:
    """The same moment with the root over the world's origin."""
    return _moved(reference, -reference.qpos[:2])


def _moved(reference: RefState, away: Array) -> RefState:
    """The same moment, elsewhere by [2] m over the ground."""
    shift = jnp.zeros_like(reference.qpos).at[:2].set(away)
    return dataclasses.replace(
        reference,
        qpos=reference.qpos + shift,
        qpos_previous=reference.qpos_previous + shift,
    )
