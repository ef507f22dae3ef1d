"""The contact solver's two forms in turns: the compiled kernel, and JAX.

    python benchmarks/solver.py [--task push] [--environments 128]

Both solve the contact problems of characters at random moments of their episodes'
beginnings, sunk in by up to 2 cm, moving and pushed at random, from accelerations of
zero: more iterations than a training needs. Mass matrix and rows are made on the way.
One core. It prints microseconds an environment by the number of iterations, and how far
the two are apart.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure(devices=1)

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import native, physics, tasks
from dcc_jax.config import make_config
from dcc_jax.env.environment import Environment
from dcc_jax.physics import contact_solver, newton_kernel
from dcc_jax.physics.quiet_mjx import mjx

Array = jax.Array

ITERATIONS = (1, 2, 4, 8)
ROUNDS = 40


def problems(environment: Environment, count: int) -> tuple[mjx.Data, Array, Array]:
    """States, smooth forces and start of `count` environments."""
    scene = environment.scene

    def one(key: Array) -> tuple[mjx.Data, Array, Array]:
        reset_key, *keys = jax.random.split(key, 4)
        body = environment.reset(reset_key).body
        sunk = 0.02 * jax.random.uniform(keys[0])
        body = dataclasses.replace(
            body,
            qpos=body.qpos.at[scene.qpos_adr + 2].add(-sunk),
            qvel=body.qvel + 0.5 * jax.random.normal(keys[1], body.qvel.shape),
        )
        data = mjx.passive(scene.mjx_model, physics.kinematics(scene, body).data)
        pushed = 20.0 * jax.random.normal(keys[2], body.qvel.shape)
        smooth = pushed + data.qfrc_passive - data.qfrc_bias
        return data, smooth, jnp.zeros_like(body.qvel)

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), count))


def solvers(environment: Environment, iterations: int) -> dict[str, Callable]:
    """Both forms, compiled for a batch."""
    scene = environment.scene
    model = scene.mjx_model

    def kernel(data: mjx.Data, smooth: Array, start: Array) -> tuple[Array, Array]:
        given = newton_kernel.problem(model, data, smooth, start)
        return newton_kernel.newton(scene.arrow, scene.layout, given, iterations)

    def in_jax(data: mjx.Data, smooth: Array, start: Array) -> tuple[Array, Array]:
        mass = physics.mass_matrix(scene, physics.Kinematics(data))
        made = mjx.make_constraint(model, data)._impl
        rows = contact_solver.Rows(made.efc_J, made.efc_D, made.efc_aref, made.ne)
        return contact_solver.newton(scene.arrow, mass, smooth, rows, start, iterations)

    return {"kernel": jax.jit(jax.vmap(kernel)), "JAX": jax.jit(jax.vmap(in_jax))}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", choices=tasks.TASKS, default="push")
    parser.add_argument("--environments", type=int, default=128)
    options = parser.parse_args()
    if options.environments < 1:
        parser.error("argument --environments: must be 1 or more")
    if not native.available():
        parser.error("there is no kernel on this machine")
    config = make_config(options.task)
    environment = tasks.make_environment(config.task, config.env)
    given = problems(environment, options.environments)
    print("iterations  kernel us  JAX us  ratio  largest difference of a force")
    for most in ITERATIONS:
        both = solvers(environment, most)
        forces = {name: np.asarray(run(*given)[1]) for name, run in both.items()}
        seconds: dict[str, list[float]] = {name: [] for name in both}
        for _ in range(ROUNDS):
            for name, run in both.items():
                start = time.perf_counter()
                jax.block_until_ready(run(*given))
                seconds[name].append(time.perf_counter() - start)
        each = {
            n: 1e6 * np.median(s) / options.environments for n, s in seconds.items()
        }
        apart = np.abs(forces["kernel"] - forces["JAX"]).max()
        apart /= np.abs(forces["JAX"]).max()
        print(
            f"{most:10}  {each['kernel']:9.1f}  {each['JAX']:6.1f}  "
            f"{each['JAX'] / each['kernel']:5.1f}  {apart:.1e}"
        )


if __name__ == "__main__":
    command.script(main)
