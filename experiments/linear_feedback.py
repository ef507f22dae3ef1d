"""Could linear feedback do it? A regulator about a pose that a clip passes.

    python experiments/linear_feedback.py ball --time 0.5 --speed 0.05 0.1 0.2 0.3
    python experiments/linear_feedback.py chicken-fight --time 0.9 --speed 0.05 0.1 0.2

Balancing is hard to learn, and a policy that has not learned it does not tell whether
anybody could. Here the pose is held by the joint targets of an equilibrium, the control
step is linearised about it, and the linear-quadratic regulator of that system takes the
policy's place, in the task's own scene, at its rate, through the same joint targets.
Printed: how fast the pose tips by itself, and the share of trials that still stand
after five seconds, by the speed that the ball (`ball`) or the root (`chicken-fight`) is
given at first, in all directions. Alpha is 0, and nothing else disturbs, but for the
noise of `--noise` degrees on every joint target, which a policy has while it learns.
What it holds can be held; what it does not, another feedback might.

Letters: N states; a [36] joint targets, x = (position, velocity) [2 nv].
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools

import numpy as np

from dcc_jax import command, runtime

runtime.ensure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402

from dcc_jax import config, tasks  # noqa: E402
from dcc_jax.character import CONTROL_RATE, asset_path  # noqa: E402
from dcc_jax.env.environment import Environment  # noqa: E402
from dcc_jax.motion.clip import load_clip  # noqa: E402
from dcc_jax.motion.reference import make_references  # noqa: E402
from dcc_jax.tasks.ball import Ball  # noqa: E402

TARGETS = 36
PROBE = 2e-3  # m, rad, m/s, rad/s: of the differences
NEVER = 1e6  # s until the task disturbs
EVENTS = {"ball": "next_push", "chicken-fight": "next_attack"}
CLIPS = {"ball": "stand", "chicken-fight": "hop"}
TRIALS, SECONDS = 64, 5.0
POSITION, VELOCITY, EFFORT = 1.0, 0.05, 1.0  # weights of the regulator
LIMIT = 1.5  # rad, of a target's distance from the equilibrium's


class System:
    """A control step as a function of position, velocity and joint targets."""

    def __init__(self, environment: Environment, time: float) -> None:
        self.model = environment.scene.model
        self.nv = self.model.nv
        clip = load_clip(asset_path(f"motions/{CLIPS[environment.task.name]}.npz"))
        reference = make_references([clip]).state_at(0, time)
        still = dataclasses.replace(
            reference,
            qvel=jnp.zeros_like(reference.qvel),
            qpos_previous=reference.qpos,
        )
        state = jax.jit(environment.reset)(jax.random.key(0))
        task, qpos, _ = jax.jit(
            lambda key: environment.task.reset(key, environment.scene, still)
        )(jax.random.key(0))
        event = EVENTS[environment.task.name]
        task = dataclasses.replace(task, **{event: jnp.asarray(NEVER)})
        state = dataclasses.replace(state, task=task, reference=still)
        self.start = np.array(qpos, float)

        def step(qpos, qvel, action):
            body = dataclasses.replace(state.body, qpos=qpos, qvel=qvel)
            before = dataclasses.replace(state, body=body)
            action = jnp.pad(action, (0, environment.action_size - TARGETS))
            after = environment.step(jax.random.key(0), before, action)
            return after.body.qpos, after.body.qvel, after.terminated

        self._step = jax.jit(jax.vmap(step))

    def step(self, qpos, qvel, action) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [N, nq] and velocities [N, nv] a control step later, and what
        has failed by then [N]."""
        single = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, action))
        after, speed, failed = self._step(*single)
        return np.array(after, float), np.array(speed, float), np.array(failed)

    def moved(self, qpos: np.ndarray, by: np.ndarray) -> np.ndarray:
        """A position [nq] moved by a tangent vector [nv]."""
        qpos = qpos.copy()
        mujoco.mj_integratePos(self.model, qpos, by, 1.0)
        return qpos

    def between(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The tangent vector [nv] from one position to another."""
        out = np.zeros(self.nv)
        mujoco.mj_differentiatePos(self.model, out, 1.0, start, end)
        return out

    def linearised(self, qpos, action) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x' = A x + B a + r about a state at rest: A, B and r."""
        nv, size = self.nv, 2 * self.nv + TARGETS
        probes = np.concatenate([np.eye(size), -np.eye(size), np.zeros((1, size))])
        probes *= PROBE
        after, speed, _ = self.step(
            np.stack([self.moved(qpos, p[:nv]) for p in probes]),
            probes[:, nv : 2 * nv],
            action + probes[:, 2 * nv :],
        )
        x = [
            np.append(self.between(qpos, q), v)
            for q, v in zip(after, speed, strict=True)
        ]
        slope = (np.array(x[:size]) - x[size:-1]).T / (2.0 * PROBE)
        return slope[:, : 2 * nv], slope[:, 2 * nv :], x[-1]

    def equilibrium(self, iterations: int = 8) -> tuple[np.ndarray, np.ndarray]:
        """A position near the clip's and joint targets that hold it: Gauss-Newton."""
        qpos, action = self.start, np.zeros(TARGETS)
        for _ in range(iterations):
            A, B, left = self.linearised(qpos, action)
            system = np.hstack([(A - np.eye(2 * self.nv))[:, : self.nv], B])
            step = -np.linalg.lstsq(system, left, rcond=1e-4)[0]
            step *= min(1.0, 0.1 / np.abs(step).max())
            qpos, action = self.moved(qpos, step[: self.nv]), action + step[self.nv :]
        return qpos, action


def regulator(A: np.ndarray, B: np.ndarray, iterations: int = 3000) -> np.ndarray:
    """Gains [36, 2 nv] of the linear-quadratic regulator, by value iteration."""
    nv = len(A) // 2
    cost = np.diag(np.repeat([POSITION, VELOCITY], nv))
    value, gains = cost, np.zeros(B.T.shape)
    for _ in range(iterations):
        inner = EFFORT * np.eye(B.shape[1]) + B.T @ value @ B
        gains = np.linalg.solve(inner, B.T @ value @ A)
        value = cost + A.T @ value @ (A - B @ gains)
        value = 0.5 * (value + value.T)
    return gains


def survivors(
    system: System, held, gains: np.ndarray, first: np.ndarray, sigma: float
) -> float:
    """Share of the trials, begun with velocities [N, nv], that do not fail.

    Joint targets have a standard deviation of sigma, rad.
    """
    qpos, action = held
    draw = np.random.default_rng(1)
    q, v = np.tile(qpos, (len(first), 1)), first
    stands = np.ones(len(first), bool)
    for _ in range(round(SECONDS * CONTROL_RATE)):
        pairs = zip(q, v, strict=True)
        x = np.stack([np.append(system.between(qpos, a), b) for a, b in pairs])
        targets = action - np.clip(x @ gains.T, -LIMIT, LIMIT)
        targets += sigma * draw.standard_normal(targets.shape)
        q, v, failed = system.step(q, v, targets)
        stands &= ~failed & np.isfinite(v).all(axis=-1)
        q[~stands], v[~stands] = qpos, 0.0
    return float(stands.mean())


def pushes(environment: Environment, speed: float) -> np.ndarray:
    """Velocities [N, nv]: the ball's, or the root's, in N directions."""
    way = np.random.default_rng(0).uniform(-np.pi, np.pi, TRIALS)
    first = np.zeros((TRIALS, environment.scene.model.nv))
    if isinstance(environment.task, Ball) and environment.task.rolls:
        dof = int(environment.scene.model.joint("ball").dofadr[0])
        first[:, dof : dof + 2] = speed * np.stack([np.cos(way), np.sin(way)], axis=1)
        spin = speed / environment.task.ball_radius
        first[:, dof + 3 : dof + 5] = spin * np.stack(
            [-np.sin(way), np.cos(way)], axis=1
        )
    elif isinstance(environment.task, Ball):
        dof = int(environment.scene.model.joint("pole").dofadr[0]) + 3
        rate = speed / environment.task.pole_length
        first[:, dof : dof + 2] = rate * np.stack([-np.sin(way), np.cos(way)], axis=1)
    else:
        dof = int(environment.scene.dof_adr)
        first[:, dof : dof + 2] = speed * np.stack([np.cos(way), np.sin(way)], axis=1)
    return first


def main() -> None:
    """Parses the arguments, finds the regulator, tries it, prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", choices=EVENTS)
    parser.add_argument("--time", type=float, default=0.5, help="s into the clip")
    parser.add_argument("--speed", type=float, nargs="+", default=[0.05, 0.1, 0.2])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0], help="degrees")
    parser.add_argument("--rolls", action="store_true", help="ball: free on a plate")
    options = parser.parse_args()
    wanted = config.make_config(options.task)
    env = dataclasses.replace(wanted.env, alpha=0.0)
    task = wanted.task
    if isinstance(task, Ball):
        task = dataclasses.replace(task, tilt=0.0, rolls=options.rolls)
    environment = tasks.make_environment(task, env)
    system = System(environment, options.time)
    held = system.equilibrium()
    A, B, left = system.linearised(*held)
    growth = np.abs(np.linalg.eigvals(A)).max()
    print(f"equilibrium: a control step moves it by {np.linalg.norm(left):.1e}")
    seconds = 1.0 / (CONTROL_RATE * np.log(growth))
    print(f"by itself it tips by a factor of e in {seconds:.2f} s")
    gains = regulator(A, B)
    for noise, speed in itertools.product(options.noise, options.speed):
        first = pushes(environment, speed)
        share = survivors(system, held, gains, first, np.radians(noise))
        print(
            f"noise {noise:g} deg, {speed:.2f} m/s: "
            f"{share:.0%} of {TRIALS} stand for {SECONDS:g} s"
        )


if __name__ == "__main__":
    command.script(main)
