"""Training tuples per second, where the time goes, and seconds to the first update.

    python benchmarks/training.py [--task push] [--preset cpu] [--json FILE]
                                  [--rounds 5] [--skip-first-update] [--skip-brax]

The parts are found by what more of them costs: an update with twice the PPO epochs, one
with twice the discriminator's minibatches, a rollout of the physics alone (kinematics,
PD, contacts, compliance) and one with the environment around it. All take turns in one
run, and shares are of medians. Brax's PPO, from `pip install dcc-jax[benchmark]`,
trains the same character in `mjx.step` at the same rate, batch and widths.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dcc_jax import command, runtime

runtime.ensure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
from jax.sharding import NamedSharding, PartitionSpec  # noqa: E402
from mujoco import mjx  # noqa: E402
from states import substep  # noqa: E402

from dcc_jax import physics, tasks  # noqa: E402
from dcc_jax.character import compose_scene, load_character  # noqa: E402
from dcc_jax.config import Config, make_config  # noqa: E402
from dcc_jax.control import pd  # noqa: E402
from dcc_jax.env.config import CONTROL_RATE  # noqa: E402
from dcc_jax.env.environment import Environment  # noqa: E402
from dcc_jax.env.state import EnvState, Substep  # noqa: E402
from dcc_jax.learn import learner  # noqa: E402
from dcc_jax.learn.update import chunk_size  # noqa: E402

Array = jax.Array


def update_of(environment: Environment, config: Config) -> Callable[[], None]:
    """One update, compiled, that goes on from its own state."""
    mesh = learner.make_mesh(config.train)
    state = learner.make_init(environment, config, mesh)(jax.random.key(0), None)
    update = learner.make_update(environment, config, mesh)

    def run() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(update(state))

    return run


def with_epochs(config: Config, epochs: int) -> Config:
    """The same with other PPO epochs."""
    return dataclasses.replace(
        config, ppo=dataclasses.replace(config.ppo, epochs=epochs)
    )


def with_minibatches(config: Config, minibatches: int) -> Config:
    """The same with other discriminator minibatches."""
    return dataclasses.replace(
        config, disc=dataclasses.replace(config.disc, minibatches=minibatches)
    )


def physics_alone(environment: Environment, state: EnvState) -> EnvState:
    """The physics steps of a control step: no observation, reward or reset."""
    action = jnp.zeros(environment.action_size)
    start, plan = environment.begin(jax.random.key(0), state, action)

    def one(carry: Substep, _: None) -> tuple[Substep, None]:
        return substep(environment, carry, plan)[0], None

    steps = environment.config.control_steps
    end, _ = jax.lax.scan(one, start, None, length=steps)
    return dataclasses.replace(
        state,
        body=end.body,
        displacement=end.displacement,
        task=end.task,
        time=end.time,
    )


def whole_step(environment: Environment, state: EnvState) -> EnvState:
    """A control step with everything that an environment does."""
    action = jnp.zeros(environment.action_size)
    return environment.step(jax.random.key(0), state, action)


def rollout_of(
    environment: Environment, config: Config, step: Callable
) -> Callable[[], None]:
    """As many control steps as an update has, sharded and chunked as in training."""
    mesh = learner.make_mesh(config.train)
    spec = PartitionSpec(learner.AXIS)
    local = config.train.num_envs // mesh.size
    chunk = chunk_size(config.train, local) or local

    def body(states: EnvState) -> EnvState:
        def over_time(states: EnvState) -> EnvState:
            def one(states: EnvState, _: None) -> tuple[EnvState, None]:
                return jax.vmap(lambda s: step(environment, s))(states), None

            length = config.train.unroll_length
            return jax.lax.scan(one, states, None, length=length)[0]

        split = jax.tree.map(
            lambda x: x.reshape(local // chunk, chunk, *x.shape[1:]), states
        )
        done = jax.lax.map(over_time, split)
        return jax.tree.map(lambda x: x.reshape(local, *x.shape[2:]), done)

    run = jax.jit(
        jax.shard_map(body, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    )
    keys = jax.random.split(jax.random.key(0), config.train.num_envs)
    states = jax.jit(jax.vmap(environment.reset))(keys)
    states = jax.device_put(states, NamedSharding(mesh, spec))
    return lambda: jax.block_until_ready(run(states))


def medians(variants: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Median seconds of each; they take turns."""
    for run in variants.values():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(rounds):
        for name, run in variants.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: statistics.median(times) for name, times in seconds.items()}


def split(config: Config, rounds: int) -> dict[str, float]:
    """Tuples per second end to end, and the share of each part."""
    environment = tasks.make_environment(config.task, config.env)
    epochs, minibatches = config.ppo.epochs, config.disc.minibatches
    seconds = medians(
        {
            "update": update_of(environment, config),
            "twice_ppo": update_of(environment, with_epochs(config, 2 * epochs)),
            "twice_disc": update_of(
                environment, with_minibatches(config, 2 * minibatches)
            ),
            "physics": rollout_of(environment, config, physics_alone),
            "environment": rollout_of(environment, config, whole_step),
        },
        rounds,
    )
    total = seconds["update"]
    ppo = seconds["twice_ppo"] - total
    disc = seconds["twice_disc"] - total
    rest = total - seconds["environment"] - ppo - disc
    return {
        "tuples_per_second": config.train.tuples_per_update / total,
        "share_physics": seconds["physics"] / total,
        "share_features_and_rewards": (seconds["environment"] - seconds["physics"])
        / total,
        "share_ppo": ppo / total,
        "share_discriminator": disc / total,
        "share_policy_resets_and_rest": rest / total,
    }


def first_update(config: Config, cache: str) -> float:
    """Seconds from the command to the first line of metrics, in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command: list[str] = [sys.executable, "-m", "dcc_jax.train"]
        command += ["--task", config.task.name]
        command += ["--preset", config.preset, "--run-dir", str(run_dir)]
        environ = os.environ | {"DCC_JAX_CACHE": cache}
        begin = time.perf_counter()
        process = subprocess.Popen(
            command,
            env=environ,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            metrics = run_dir / "metrics.jsonl"
            while not (metrics.exists() and metrics.stat().st_size):
                if process.poll() is not None:
                    raise SystemExit(f"{' '.join(command)} failed")
                time.sleep(0.1)
            return time.perf_counter() - begin
        finally:
            process.kill()
            process.wait()


def brax_rate(config: Config) -> float:
    """Tuples per second of Brax's PPO on `mjx.step` of the same character."""
    from brax.envs.base import Env, State  # pyright: ignore[reportMissingImports]
    from brax.training.agents.ppo import (  # pyright: ignore[reportMissingImports]
        networks,
        train,
    )

    character = load_character()
    scene = physics.make_scene(
        compose_scene(character, timestep=1.0 / config.env.physics_rate), character
    )
    model = scene.model
    model.opt.iterations, model.opt.ls_iterations = 4, 8
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    device_model = mjx.put_model(model)
    substeps = config.env.physics_rate // CONTROL_RATE

    class Standing(Env):
        """Keep standing: a pose is asked for, the pelvis has to stay up."""

        observation_size = model.nq + model.nv
        action_size = 36
        backend = "mjx"

        def reset(self, rng: Array) -> State:
            qpos = jnp.asarray(model.qpos0, jnp.float32)
            qvel = 0.01 * jax.random.normal(rng, (model.nv,))
            data = mjx.make_data(device_model).replace(qpos=qpos, qvel=qvel)
            zero = jnp.zeros(())
            obs = jnp.concatenate([data.qpos, data.qvel])
            return State(mjx.forward(device_model, data), obs, zero, zero, {}, {})

        def step(self, state: State, action: Array) -> State:
            pose = jnp.asarray(model.qpos0, jnp.float32)
            turned = 0.1 * action.reshape(12, 3)
            joints = jnp.concatenate([jnp.ones((12, 1)), 0.5 * turned], axis=1)
            joints /= jnp.linalg.norm(joints, axis=1, keepdims=True)
            target = pose.at[7:55].set(joints.reshape(-1))

            def substep(data: Any, _: None) -> tuple[Any, None]:
                tau = pd.torque(character, data.qpos, data.qvel, target, scene.timestep)
                data = data.replace(qfrc_applied=tau)
                return mjx.step(device_model, data), None

            data, _ = jax.lax.scan(substep, state.pipeline_state, None, length=substeps)
            up = data.qpos[2] > config.env.fall_height
            return dataclasses.replace(
                state,
                pipeline_state=data,
                obs=jnp.concatenate([data.qpos, data.qvel]),
                reward=jnp.exp(-jnp.abs(data.qpos[2] - 0.9)),
                done=1.0 - up,
            )

    reports: list[tuple[int, float]] = []
    tuples = config.train.tuples_per_update
    minibatches = tuples // config.ppo.minibatch_size
    train.train(
        environment=Standing(),
        num_timesteps=3 * tuples,
        num_envs=config.train.num_envs,
        episode_length=round(config.env.episode_seconds * CONTROL_RATE),
        unroll_length=config.train.unroll_length,
        num_minibatches=minibatches,
        batch_size=config.train.num_envs // minibatches,
        num_updates_per_batch=config.ppo.epochs,
        discounting=config.ppo.discount,
        gae_lambda=config.ppo.gae_lambda,
        normalize_observations=True,
        num_evals=4,
        run_evals=False,
        network_factory=lambda *args, **kwargs: networks.make_ppo_networks(
            *args,
            policy_hidden_layer_sizes=config.ppo.hidden,
            value_hidden_layer_sizes=config.ppo.hidden,
            **kwargs,
        ),
        progress_fn=lambda steps, _: reports.append((steps, time.perf_counter())),
    )
    # The first epoch compiles, the others do not.
    rates = [
        (after - before) / (end - begin)
        for (before, begin), (after, end) in itertools.pairwise(reports[1:])
    ]
    return statistics.median(rates)


def main() -> None:
    """Parses the arguments, measures, prints, writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="push")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", help="write the numbers to this file")
    parser.add_argument("--skip-first-update", action="store_true")
    parser.add_argument("--skip-brax", action="store_true")
    args = parser.parse_args()
    brax = not args.skip_brax
    if brax and importlib.util.find_spec("brax") is None:
        raise SystemExit(
            "Brax is not installed: pip install 'dcc-jax[benchmark]', or --skip-brax"
        )
    config = make_config(args.task, args.preset)
    report: dict[str, object] = {
        "device": f"{len(jax.devices())} x {jax.devices()[0].device_kind}",
        "jax": jax.__version__,
        "task": args.task,
        "preset": args.preset,
    }
    if not args.skip_first_update:
        with tempfile.TemporaryDirectory() as cache:
            report["first_update_cold_s"] = round(first_update(config, cache), 1)
            report["first_update_warm_s"] = round(first_update(config, cache), 1)
    measured = split(config, args.rounds)
    report |= {name: round(value, 3) for name, value in measured.items()}
    if brax:
        rate = brax_rate(config)
        report["brax_tuples_per_second"] = round(rate, 1)
        ratio = measured["tuples_per_second"] / rate
        report["ratio_ours_brax"] = round(ratio, 2)
    for name, value in report.items():
        print(f"{name:28s} {value}")
    if args.json:
        with open(args.json, "w") as file:
            json.dump(report, file, indent=2)


if __name__ == "__main__":
    command.script(main)
