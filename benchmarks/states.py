"""States to step from: a standing character, and those that a training visits.

Both come as the beginning of a control step of an `Environment`, so that what is
measured is the physics step that trains.

Letters: B environments, T physics steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from stepping import Drive, Job, compiled, compiled_batch

from dcc_jax import physics, tasks
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import Environment
from dcc_jax.env.state import ControlInputs, EnvState, Substep
from dcc_jax.env.substep import physics_step, scene_forces
from dcc_jax.env.task import Forces, Nothing, Task
from dcc_jax.learn import rollout
from dcc_jax.play.runs import Run, find_run

Array = jax.Array
CONTROL_STEPS = 60  # from the reset to the states of a training: 2 s
STANDING_STEPS = 48  # physics steps of a call


@dataclass(frozen=True)
class Start:
    """The beginning of a control step in B environments."""

    environment: Environment
    carry: Substep  # [B, ...]
    plan: ControlInputs  # [B, ...]
    steps: int  # physics steps of a call, T


@dataclass(frozen=True)
class Standing(Task):
    """A character alone on the floor; compliance reacts to its first two contacts."""

    name: ClassVar[str] = "standing"

    def forces(
        self,
        scene: physics.Scene,
        state: Nothing,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[Nothing, Forces]:
        """Two contacts of a sole, F = 2."""
        return state, Forces(
            force_w=solution.contact_force_w[:2],
            point_w=solution.contact_point_w[:2],
            body=jnp.asarray(scene.contact_bodies[:2, 1]),
            gate=jnp.asarray(True),
        )


def standing(count: int) -> Start:
    """Slightly different characters on their soles, held in the T-pose."""
    environment = tasks.make_environment(Standing(), EnvConfig())
    scene = environment.scene
    qpos0 = jnp.asarray(scene.model.qpos0, jnp.float32)

    def begin(key: Array) -> tuple[Substep, ControlInputs]:
        reset_key, qvel_key, step_key = jax.random.split(key, 3)
        qvel = 0.01 * jax.random.normal(qvel_key, (scene.model.nv,))
        state = environment.reset(reset_key)
        state = dataclasses.replace(
            state, body=physics.initial_state(scene, qpos0, qvel)
        )
        action = jnp.zeros(environment.action_size)
        carry, plan = environment.begin(step_key, state, action)
        return carry, dataclasses.replace(plan, pose=qpos0)

    carry, plan = jax.jit(jax.vmap(begin))(_keys(count))
    return Start(environment, carry, plan, STANDING_STEPS)


def visited(name: str, count: int, noise_degrees: float | None) -> Start:
    """What a training of the policy `name` meets, `CONTROL_STEPS` in.

    The policy acts with noise and an episode that ends begins anew, by the rollout of
    the training itself.

    Args:
        name: of a policy that ships, or a run directory.
        count: B.
        noise_degrees: of the actions; None: what the policy was trained with.
    """
    run = _noisy(find_run(name), noise_degrees)
    environment = tasks.make_environment(run.config.task, run.config.env)
    share = count // len(jax.devices())

    def begin(key: Array) -> tuple[Substep, ControlInputs]:
        play_key, noise_key, step_key = jax.random.split(key[0], 3)
        states = _played(play_key, run, environment, share)
        noise = jax.random.normal(noise_key, (share, environment.action_size))
        action = run.policy.mean(states.obs) + run.config.ppo.sigma * noise
        keys = jax.random.split(step_key, share)
        return jax.vmap(environment.begin)(keys, states, action)

    carry, plan = compiled_batch(begin, _keys(len(jax.devices())))()
    return Start(environment, carry, plan, environment.config.control_steps)


def _noisy(run: Run, degrees: float | None) -> Run:
    if degrees is None:
        return run
    ppo = dataclasses.replace(run.config.ppo, sigma_degrees=degrees)
    return dataclasses.replace(run, config=dataclasses.replace(run.config, ppo=ppo))


def _played(key: Array, run: Run, environment: Environment, count: int) -> EnvState:
    """`CONTROL_STEPS` from fresh episodes on, [count, ...]."""
    reset_key, play_key = jax.random.split(key)
    # Values are not read, so that any network will do.
    actors = rollout.Actors(policy=run.policy, value=run.policy.params, alpha=None)
    keys = jax.random.split(reset_key, count)
    running = rollout.reset_all(keys, environment, None)
    return rollout.rollout(
        play_key, environment, actors, running, CONTROL_STEPS, run.config.ppo
    ).running.env


def with_compliance(start: Start) -> Callable[[], tuple[Substep, Drive]]:
    """The physics steps of a training, compiled: PD, task, physics, compliance.

    A call gives the end [B, ...] and what acted on the scene on the way [B, T, ...].
    """

    def steps(carry: Substep, plan: ControlInputs) -> tuple[Substep, Drive]:
        def step(carry: Substep, _: None) -> tuple[Substep, Drive]:
            return substep(start.environment, carry, plan)

        return jax.lax.scan(step, carry, None, length=start.steps)

    return compiled(steps, start.carry, start.plan)


def substep(
    environment: Environment, carry: Substep, plan: ControlInputs
) -> tuple[Substep, Drive]:
    """One physics step of ONE environment, and what acted on the scene in it."""
    sides, scene = [environment.side], environment.scene
    world = environment.task.world(scene, carry.task, carry.time)
    kin = physics.kinematics(scene, carry.body, world)
    # Computed in the step itself as well; the compiler makes one of the two.
    _, qfrc = scene_forces(sides, [carry], [plan], kin)
    ((after, _),) = physics_step(sides, [carry], [plan])
    return after, Drive(qfrc, world)


def job(start: Start, drive: Drive) -> Job:
    """The same physics steps for engines that know the scene alone."""
    return Job(start.environment.scene, start.carry.body, drive)


def _keys(count: int) -> Array:
    return jax.random.split(jax.random.key(0), count)
