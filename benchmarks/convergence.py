"""How many Newton iterations contact forces need, task by task.

    python benchmarks/convergence.py [TASK...] [--steps 200]

64 untrained characters a task act at random. At every control step the contact problem
of their state is solved with few iterations and with 24, from the same start; the table
has the share of states whose contact forces differ by more than 1 %.
"""

from __future__ import annotations

import argparse
import dataclasses

from dcc_jax import command, runtime

runtime.ensure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from dcc_jax import physics, tasks  # noqa: E402
from dcc_jax.config import make_config  # noqa: E402
from dcc_jax.env.environment import Environment  # noqa: E402
from dcc_jax.env.state import EnvState  # noqa: E402

Array = jax.Array
AT_MOST, CONVERGED = (2, 3, 4, 5, 6, 8), 24
ENVIRONMENTS = 64
NOISE = 0.08  # rad, of the actions
TOUCHING = 20.0  # N; states with less force are left out


def errors(environment: Environment, state: EnvState) -> tuple[Array, Array]:
    """Sum of the forces' errors [len(AT_MOST)], N, and of the forces [], N."""
    scene, task = environment.scene, environment.task
    world = task.world(scene, state.task, state.time)
    kin = physics.kinematics(scene, state.body, world)

    def forces(iterations: int) -> Array:
        limited = dataclasses.replace(scene, newton_iterations=iterations)
        qfrc = jnp.zeros(scene.model.nv)
        return physics.solve(limited, kin, state.body, qfrc).contact_force_w

    def size(force: Array) -> Array:
        return jnp.sum(jnp.linalg.norm(force, axis=-1))

    true = forces(CONVERGED)
    return jnp.stack([size(forces(n) - true) for n in AT_MOST]), size(true)


def measured(environment: Environment, steps: int) -> np.ndarray:
    """Share of states [len(AT_MOST)] with an error above 1 %."""

    def reset(keys: Array) -> EnvState:
        return jax.vmap(environment.reset)(keys)

    def step(states: EnvState, key: Array) -> tuple[EnvState, tuple[Array, Array]]:
        action_key, step_key, reset_key = jax.random.split(key, 3)
        size = ENVIRONMENTS, environment.action_size
        actions = NOISE * jax.random.normal(action_key, size)
        keys = jax.random.split(step_key, ENVIRONMENTS)
        after = jax.vmap(environment.step)(keys, states, actions)
        found = jax.vmap(lambda s: errors(environment, s))(after)
        fresh = reset(jax.random.split(reset_key, ENVIRONMENTS))
        ends = after.terminated | after.truncated
        going_on = jax.tree.map(
            lambda new, old: jnp.where(
                ends.reshape(-1, *[1] * (old.ndim - 1)), new, old
            ),
            fresh,
            after,
        )
        return going_on, found

    @jax.jit
    def play(key: Array) -> tuple[Array, Array]:
        first, rest = jax.random.split(key)
        states = reset(jax.random.split(first, ENVIRONMENTS))
        return jax.lax.scan(step, states, jax.random.split(rest, steps))[1]

    error, total = (np.asarray(x) for x in play(jax.random.key(0)))
    touching = total > TOUCHING
    return (error[touching] > 0.01 * total[touching, None]).mean(axis=0)


def main() -> None:
    """Parses the arguments, measures, prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = ["push", "hand-in-hand", "chicken-fight", "door", "ball", "trampoline"]
    parser.add_argument("tasks", nargs="*", default=default, metavar="TASK")
    parser.add_argument("--steps", type=int, default=200, help="control steps (200)")
    args = parser.parse_args()
    print(f"{'at most':15s}" + "".join(f"{n:>9d}" for n in AT_MOST))
    for name in args.tasks:
        config = make_config(name)
        shares = measured(tasks.make_environment(config.task, config.env), args.steps)
        print(f"{name:15s}" + "".join(f"{s:9.2%}" for s in shares), flush=True)


if __name__ == "__main__":
    command.script(main)
