"""One environment: forces, compliance, PD, physics, features, rewards.

A control step is `control_steps` physics steps of

    kinematics -> PD torques (Eq. 2) -> MJX -> external forces -> u (Alg. 1) -> advance,

then the state (Sec. 4.2), the positional and the task reward (Eq. 14), and whether the
episode ends. It knows no task and no discriminator; both come from outside.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT, Character, compose_scene
from dcc_jax.control import compliance, pd
from dcc_jax.control.compliance import Displacement
from dcc_jax.env import (
    expert,
    features,
    metrics,
    observation,
    outcome,
    pairs,
    relative,
    rewards,
)
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.state import ControlInputs, EnvState, Substep, terminate_on_nonfinite
from dcc_jax.env.task import Forces, RootTarget, Task
from dcc_jax.motion.reference import References, RefState

Array = jax.Array


class Environment:
    """Static parts of one task's environment; its methods are pure.

    Raises:
        ValueError: measured velocities where the reference is not followed in time.
    """

    def __init__(
        self,
        task: Task,
        character: Character,
        references: References,
        config: EnvConfig,
    ) -> None:
        _check_velocity(task, config)
        self.task = task
        self.config = config
        self.references = references
        model = compose_scene(
            character,
            timestep=1.0 / config.physics_rate,
            floor=task.has_floor,
            extend=task.extend,
        )
        self.scene = physics.make_scene(
            model, character, newton_iterations=config.newton_iterations
        )
        alone = compose_scene(character, floor=False)
        self.kinematics = features.Kinematics.of(alone)
        self.nominal = jax.jit(expert.nominal_pose)(references)
        self.controller = compliance.Controller(
            config.compliance,
            self.kinematics.coords,
            character.column_weight,
            self.scene.timestep,
        )
        self.fallen = outcome.FallTest.of(config, references)
        self.expert_lead = expert.lead(character, CONTROL_DT)
        self.action_size = character.num_joint_dofs + task.extra_actions
        self.observation_size = observation.size(task)
        self.feature_size = features.FEATURE_SIZE
        self.condition_size = 0
        self.has_task_reward = task.has_reward
        self.tracks_reference = task.tracks_reference

    def reset(self, key: Array, alpha: Array | None = None) -> EnvState:
        """A new episode at a moment of the reference (Reference State Initialization).

        Args:
            key: consumed.
            alpha: level of compliance; None draws what the configuration says.
        """
        reference_key, task_key, alpha_key = jax.random.split(key, 3)
        reference, start = self._drawn(reference_key)
        task, qpos, qvel = self.task.reset(task_key, self.scene, start)
        body = physics.initial_state(self.scene, qpos, qvel)
        displacement = compliance.at_rest(self.kinematics.coords)
        zero = jnp.zeros(())
        state = EnvState(
            obs=jnp.zeros(self.observation_size),
            features=jnp.zeros(self.feature_size),
            previous_features=jnp.zeros(self.feature_size),
            condition=jnp.zeros(0),
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
            q_previous=start.qpos_previous,
            start=RootTarget(start.qpos[:2], start.travel),
            reference=reference,
            alpha=self._alpha(alpha_key) if alpha is None else jnp.asarray(alpha),
            time=zero,
            task=task,
        )
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
        def substep(carry: Substep, _: None) -> tuple[Substep, Forces | None]:
            carry, forces = self._substep(carry, plan)
            return carry, forces if record else None

        start, plan = self.begin(key, state, action)
        steps = self.config.control_steps
        end, forces = jax.lax.scan(substep, start, None, length=steps)
        return self.end(state, plan, end), forces

    def begin(
        self, key: Array, state: EnvState, action: Array
    ) -> tuple[Substep, ControlInputs]:
        """The beginning of a control step."""
        task, body = self.task.control_step(key, self.scene, state.task, state.body)
        reference = self._following(state.reference, task)
        pose = self._target_pose(reference, action)
        sums = metrics.no_sums(state.alpha)
        start = Substep(body, state.displacement, task, state.time, sums)
        return start, ControlInputs(
            action, pose, state.alpha, state.reference, reference, state.time
        )

    def end(self, state: EnvState, plan: ControlInputs, end: Substep) -> EnvState:
        """The state after a control step, by that before it and its last substep."""
        new = dataclasses.replace(
            state,
            body=end.body,
            displacement=end.displacement,
            task=end.task,
            time=end.time,
            reference=plan.reference,
            q_previous=self.scene.character_qpos(state.body.qpos),
            u_previous=state.displacement.u,
            previous_features=state.features,
            metrics=metrics.metrics(
                end.sums,
                self.config.control_steps,
                self.kinematics.coords,
                end.displacement.u,
            ),
        )
        return terminate_on_nonfinite(self._judged(self.observed(new)), state)

    def expert_pairs(self, key: Array, n: int) -> tuple[Array, Array, Array]:
        """(s, s') ~ M: features [n, 270] twice, and the condition [n, 0]."""
        s, s_next = expert.pairs(self.kinematics, self.references, key, n)
        return s, s_next, jnp.zeros((n, 0))

    def expert_action(self, key: Array) -> tuple[Array, Array]:
        """A moment of the clips and what leads on from there: obs [O], action [A]."""
        state, task = self.reset(key), self.task
        at = state.reference
        ahead = task.reference(self.references, state.task, at, self.expert_lead)
        follows = task.tracks_reference
        base = self._following(at, state.task).qpos if follows else self.nominal
        turn = expert.action(self.kinematics, base, ahead.qpos)
        return state.obs, jnp.pad(turn, (0, task.extra_actions))

    def style_coordinates(self, s: Array, s_next: Array) -> Array:
        """Pairs of features [..., 270] as points [..., 225] in m (`learn.style`)."""
        return pairs.pair_coordinates(s, s_next, CONTROL_DT)

    def _drawn(self, key: Array) -> tuple[RefState, RefState]:
        """The moment of the reference an episode begins at, and the start beside it."""
        clip_key, place_key = jax.random.split(key)
        begin = not self.config.random_start
        reference = self.task.first_reference(clip_key, self.references, begin)
        if not self.task.tracks_reference:
            reference = _at_origin(reference)
            return reference, reference
        radius = self.task.start_radius
        away = jax.random.uniform(place_key, (2,), minval=-radius, maxval=radius)
        return reference, _moved(reference, away)

    def _following(self, reference: RefState, task: Any) -> RefState:
        """The reference a control step later, where it is followed in time."""
        if not self.task.tracks_reference:
            return reference
        return self.task.reference(self.references, task, reference, CONTROL_DT)

    def _alpha(self, key: Array) -> Array:
        low, high = self.config.alpha, self.config.alpha_max
        if high is None:
            return jnp.asarray(low)
        return jax.random.uniform(key, minval=low, maxval=high)

    def _substep(self, carry: Substep, plan: ControlInputs) -> tuple[Substep, Forces]:
        scene, task = self.scene, self.task
        world = task.world(scene, carry.task, carry.time)
        kin = physics.kinematics(scene, carry.body, world)
        tau = self.torque(carry, plan)
        qfrc = scene.scatter_character(tau)
        qfrc = qfrc + task.applied(scene, carry.task, kin, carry.time)
        solution = physics.solve(scene, kin, carry.body, qfrc)
        return self.react(carry, plan, kin, tau, solution)

    def react(
        self,
        carry: Substep,
        plan: ControlInputs,
        kin: physics.Kinematics,
        tau: Array,
        solution: physics.Solution,
    ) -> tuple[Substep, Forces]:
        """A physics step later: what the solution does to body and displacement.

        Args:
            carry: at the beginning of the physics step.
            plan: of the control step.
            kin: at the beginning of the physics step.
            tau: torques applied to the character [42], from `torque`.
            solution: accelerations and forces under them.
        """
        scene, task = self.scene, self.task
        task_state, forces = task.forces(scene, carry.task, kin, solution, plan.action)
        displacement = self.displaced(carry, plan, kin, forces)
        sums = metrics.add(
            carry.sums,
            jnp.where(forces.gate, forces.force_w, 0.0),
            self._joint_torque(tau, solution.qacc),
            scene.character_qvel(carry.body.qvel)[6:],
            scene.timestep,
        )
        return Substep(
            body=physics.integrate(scene, carry.body, solution),
            displacement=displacement,
            task=task_state,
            time=carry.time + scene.timestep,
            sums=sums,
        ), forces

    def _joint_torque(self, tau: Array, qacc: Array) -> Array:
        """Torques [36] of the joints: tau less the stable PD's implicit h kv qacc."""
        implicit = jnp.asarray(self.scene.spd_diagonal, qacc.dtype) * qacc
        return (tau - self.scene.character_qvel(implicit))[6:]

    def _target_pose(self, reference: RefState, action: Array) -> Array:
        """What the policy asks for [55]: a (+) from the clip's pose or the nominal."""
        pose = reference.qpos if self.task.tracks_reference else self.nominal
        tangent = jnp.concatenate(
            [jnp.zeros(6, action.dtype), action[: Character.num_joint_dofs]]
        )
        coords = self.kinematics.coords
        return quat.oplus(coords, pose, quat.exp_map(coords, tangent))

    def torque(self, carry: Substep, plan: ControlInputs) -> Array:
        """Stable PD torques [42], N m, towards the pose asked for (+) u."""
        scene, target = self.scene, plan.pose
        if self.config.displace_target:
            target = quat.oplus(self.kinematics.coords, target, carry.displacement.u)
        return pd.torque(
            scene.character,
            scene.character_qpos(carry.body.qpos),
            scene.character_qvel(carry.body.qvel),
            target,
            scene.timestep,
        )

    def displaced(
        self,
        carry: Substep,
        plan: ControlInputs,
        kin: physics.Kinematics,
        forces: Forces,
    ) -> Displacement:
        """u and its velocity a physics step later."""
        scene = self.scene
        jacobian = jax.vmap(lambda p, b: physics.point_jacobian(scene, kin, p, b))
        J = scene.character_qvel(jacobian(forces.point_w, forces.body))
        force = jnp.where(forces.gate, forces.force_w, 0.0)
        given = self.controller, carry.displacement, J, force, plan.alpha
        if self.config.compliance.velocity == "measured":
            xd = relative.velocity(scene, self.kinematics, carry, plan, J, forces)
            return compliance.measured(*given, xd)

        def mass_solve(qfrc: Array) -> Array:
            qfrc = jax.vmap(scene.scatter_character)(qfrc)
            return scene.character_qvel(physics.mass_solve(scene, kin, qfrc))

        return compliance.algorithm_1(*given, mass_solve)

    def observed(self, state: EnvState) -> EnvState:
        """Fills in the features and the observation."""
        obs, body_features = observation.observation(
            self.task, self.scene, self.kinematics, state, self._root_target(state)
        )
        first = state.time == 0.0
        return dataclasses.replace(
            state,
            obs=obs,
            features=body_features,
            previous_features=jnp.where(first, body_features, state.previous_features),
        )

    def _judged(self, state: EnvState) -> EnvState:
        """Fills in rewards and endings."""
        scene, task, config = self.scene, self.task, self.config
        q = scene.character_qpos(state.body.qpos)
        qd = scene.character_qvel(state.body.qvel)
        target = self._root_target(state)
        ground = task.ground_height(scene, state.task, state.body)
        r_q, over = jnp.zeros(()), state.time >= config.episode_seconds - 1e-4
        if task.tracks_reference:
            r_q = outcome.tracking(
                self.kinematics,
                q,
                state.displacement.u,
                state.reference.qpos,
                config.reward,
            )
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
        if self.task.tracks_reference:
            return RootTarget(state.reference.qpos[:2], state.reference.qvel[:2])
        return self.task.root_target(self.scene, state.task, state.start, state.time)


def _check_velocity(task: Task, config: EnvConfig) -> None:
    if config.compliance.velocity == "measured" and not task.tracks_reference:
        raise ValueError(
            "env.compliance.velocity must be 'forward_dynamics' for task "
            f"{task.name!r}, which follows no reference in time, got 'measured'"
        )


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
