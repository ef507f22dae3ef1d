"""One physics step of the characters in a scene, each with its task and its u.

    kinematics -> PD torques, Eq. (2) -> MJX -> external forces -> u, Alg. 1 -> advance

Everything is written for ONE scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from dcc_jax import physics, quat
from dcc_jax.control import compliance, pd
from dcc_jax.control.compliance import Controller, Displacement
from dcc_jax.env import metrics, relative
from dcc_jax.env.features import Kinematics
from dcc_jax.env.state import ControlInputs, Substep
from dcc_jax.env.task import Forces, Task

Array = jax.Array


@dataclass(frozen=True, eq=False)
class Side:
    """One character with its task: the static parts of a physics step."""

    scene: physics.Scene  # as this character sees it
    task: Task
    kinematics: Kinematics
    controller: Controller  # of its compliance
    displace_target: bool  # whether the PD's target is a (+) u

    def torque(self, carry: Substep, inputs: ControlInputs) -> Array:
        """Stable PD torques [42], N m, towards the pose asked for (+) u."""
        scene, target = self.scene, inputs.pose
        if self.displace_target:
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
        inputs: ControlInputs,
        kin: physics.Kinematics,
        forces: Forces,
    ) -> Displacement:
        """u and its velocity a physics step later."""
        scene = self.scene
        force = jnp.where(forces.gate, forces.force_w, 0.0)
        where = forces.point_w, forces.body
        before, law = (self.controller, carry.displacement), self.controller.config.law
        level = inputs.alpha, inputs.room
        if law == "admittance":
            torque = physics.generalized_force(scene, kin, *where, force)
            torque = scene.character_qvel(torque)
            return compliance.admittance(*before, torque, *level)
        jacobian = jax.vmap(lambda p, b: physics.point_jacobian(scene, kin, p, b))
        J = scene.character_qvel(jacobian(*where))
        given = *before, J, force, *level
        if law == "measured":
            xd = relative.velocity(scene, self.kinematics, carry, inputs, J, forces)
            return compliance.measured(*given, xd)

        def mass_solve(qfrc: Array) -> Array:
            qfrc = jax.vmap(scene.scatter_character)(qfrc)
            return scene.character_qvel(physics.mass_solve(scene, kin, qfrc))

        return compliance.algorithm_1(*given, mass_solve)

    def react(
        self,
        carry: Substep,
        inputs: ControlInputs,
        kin: physics.Kinematics,
        tau: Array,
        solution: physics.Solution,
    ) -> tuple[Substep, Forces]:
        """A physics step later: what the solution does to body and displacement.

        Args:
            carry: at the beginning of the physics step.
            inputs: of the control step.
            kin: at the beginning of the physics step.
            tau: torques applied to the character [42], from `torque`.
            solution: accelerations and forces under them.
        """
        scene, task = self.scene, self.task
        task_state, forces = task.forces(
            scene, carry.task, kin, solution, inputs.action
        )
        displacement = self.displaced(carry, inputs, kin, forces)
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


def physics_step(
    sides: Sequence[Side], carries: Sequence[Substep], inputs: Sequence[ControlInputs]
) -> list[tuple[Substep, Forces]]:
    """A physics step later, and the forces passed to the compliance controller.

    Args:
        sides: of the characters, which share a scene.
        carries: of each, at the beginning of the step; their body is one and the same.
        inputs: of each, for the control step.
    """
    first, carry = sides[0], carries[0]
    world = first.task.world(first.scene, carry.task, carry.time)
    kin = physics.kinematics(first.scene, carry.body, world)
    taus, qfrc = scene_forces(sides, carries, inputs, kin)
    solution = physics.solve(first.scene, kin, carry.body, qfrc)
    return [
        side.react(own, given, kin, tau, solution)
        for side, own, given, tau in zip(sides, carries, inputs, taus, strict=True)
    ]


def scene_forces(
    sides: Sequence[Side],
    carries: Sequence[Substep],
    inputs: Sequence[ControlInputs],
    kin: physics.Kinematics,
) -> tuple[list[Array], Array]:
    """What acts on a scene beside its constraints: PD torques and the surroundings.

    Args:
        sides: as of `physics_step`.
        carries: likewise.
        inputs: likewise.
        kin: at the beginning of the step.

    Returns:
        the torques [42] of each character, N m, and all generalized forces [nv].
    """
    taus, qfrc = [], jnp.zeros(sides[0].scene.model.nv)
    for side, own, given in zip(sides, carries, inputs, strict=True):
        tau = side.torque(own, given)
        qfrc = qfrc + side.scene.scatter_character(tau)
        qfrc = qfrc + side.task.applied(side.scene, own.task, kin, own.time)
        taus.append(tau)
    return taus, qfrc
