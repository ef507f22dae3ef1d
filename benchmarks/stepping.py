"""Three engines that step one batch of environments, and the rates of all of them.

Every engine gets the same scene, the same states and the same forces, physics step by
physics step: C MuJoCo (`mujoco.rollout`), `vmap(mjx.step)` as everyone writes it, and
ours. A measured call begins again at the same states.

Letters: B environments, T physics steps of a call.
"""

from __future__ import annotations

import copy
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import mujoco
import mujoco.rollout
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from mujoco import mjx

from dcc_jax import physics

Array = jax.Array
TIMED = 6000  # physics steps at least between two looks at the clock, 50 ms


@flax.struct.dataclass
class Drive:
    """What acts on a scene in one physics step; a batch has leaves [B, T, ...]."""

    qfrc: Array  # [nv] applied generalized forces
    world: physics.World | None  # kinematic bodies and switches; None: as declared


@dataclass(frozen=True)
class Job:
    """What an engine has to step."""

    scene: physics.Scene
    states: physics.State  # [B, ...]
    drive: Drive  # [B, T, ...]

    @property
    def count(self) -> int:
        """Physics steps of one call, those of all environments together."""
        return self.drive.qfrc.shape[0] * self.drive.qfrc.shape[1]


def compiled(function: Callable, *batch: Any) -> Callable[[], Any]:
    """`function` of ONE environment, compiled for a batch [B, ...] on all devices."""
    return compiled_batch(jax.vmap(function), *batch)


def compiled_batch(function: Callable, *batch: Any) -> Callable[[], Any]:
    """`function` of a device's share of a batch, compiled for all devices."""
    program, batch = placed(function, *batch)
    return lambda: jax.block_until_ready(program(*batch))


def placed(function: Callable, *batch: Any) -> tuple[jax.stages.Compiled, tuple]:
    """The compiled program, and the batch where it wants it."""
    spec = PartitionSpec("env")
    mesh = Mesh(np.array(jax.devices()), ("env",))
    mapped = jax.shard_map(
        function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )
    batch = jax.device_put(batch, NamedSharding(mesh, spec))
    return jax.jit(mapped).lower(*batch).compile(), batch


def ours(job: Job) -> Callable[[], physics.State]:
    """Our physics step, without compliance."""
    return compiled(our_steps(job), job.states, job.drive)


def our_steps(job: Job) -> Callable[[physics.State, Drive], physics.State]:
    """Of ONE environment."""
    scene = job.scene

    def step(state: physics.State, drive: Drive) -> tuple[physics.State, None]:
        kin = physics.kinematics(scene, state, drive.world)
        solution = physics.solve(scene, kin, state, drive.qfrc)
        return physics.integrate(scene, state, solution), None

    def steps(state: physics.State, drive: Drive) -> physics.State:
        return jax.lax.scan(step, state, drive)[0]

    return steps


def naive_mjx(job: Job) -> Callable[[], mjx.Data]:
    """`vmap(mjx.step)` with the whole `mjx.Data` carried and MJX's own solver.

    For scenes without a world of their own.
    """
    model = copy.copy(job.scene.model)
    model.opt.iterations, model.opt.ls_iterations = 4, 8
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    device_model = mjx.put_model(model)

    def step(data: mjx.Data, drive: Drive) -> tuple[mjx.Data, None]:
        return mjx.step(device_model, data.replace(qfrc_applied=drive.qfrc)), None

    def steps(state: physics.State, drive: Drive) -> mjx.Data:
        data = mjx.make_data(device_model)
        data = data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc)
        return jax.lax.scan(step, data, drive)[0]

    return compiled(steps, job.states, job.drive)


def c_mujoco(job: Job, threads: int) -> Callable[[], np.ndarray]:
    """C MuJoCo at its own defaults on `threads` threads; gives the final qpos [B, nq].

    It starts from the same accelerations as ours does.
    """
    model, full = job.scene.model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    size = mujoco.mj_stateSize(model, full)
    control, spec = _control(job.drive)
    count, length = control.shape[:2]
    initial = np.zeros((count, size))
    initial[:, 1 : 1 + model.nq] = job.states.qpos
    initial[:, 1 + model.nq : 1 + model.nq + model.nv] = job.states.qvel
    warm = np.asarray(job.states.qacc, float)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)
    out = np.zeros((count, length, size))

    def run() -> np.ndarray:
        pool.rollout(
            [model] * count,
            datas,
            initial,
            control,
            control_spec=spec,
            initial_warmstart=warm,
            state=out,
        )
        return out[:, -1, 1 : 1 + model.nq]

    return run


def _control(drive: Drive) -> tuple[np.ndarray, int]:
    """The drive as C MuJoCo's vector of inputs [B, T, ...], and what is in it."""
    kinds = mujoco.mjtState
    parts, spec = [drive.qfrc], int(kinds.mjSTATE_QFRC_APPLIED)
    if drive.world is not None:
        world = drive.world
        parts += [world.equality_active, world.mocap_pos, world.mocap_quat]
        spec |= int(kinds.mjSTATE_EQ_ACTIVE)
        spec |= int(kinds.mjSTATE_MOCAP_POS) | int(kinds.mjSTATE_MOCAP_QUAT)
    batch = drive.qfrc.shape[:2]
    flat = [np.asarray(part, float).reshape(*batch, -1) for part in parts]
    return np.concatenate(flat, axis=-1), spec


def rates(runs: dict[str, Callable], count: int, rounds: int) -> dict[str, float]:
    """Median physics steps per second of each, which take turns.

    Args:
        runs: one call of each.
        count: physics steps of a call.
        rounds: turns.
    """
    calls = -(-TIMED // count)
    for run in runs.values():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.perf_counter()
            for _ in range(calls):
                run()
            seconds[name].append(time.perf_counter() - begin)
    return {
        name: calls * count / statistics.median(times)
        for name, times in seconds.items()
    }
