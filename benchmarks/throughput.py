"""Physics steps per second and contact-force error, all in one run.

    python benchmarks/throughput.py [--json FILE] [--quick]

One scene (the character standing on the floor, 240 Hz, contacts active) stepped by C
MuJoCo with one and with all threads, by `vmap(mjx.step)` as everyone writes it, and by
ours without and with the compliance step. The machine's speed drifts, so the variants
take turns and ratios are of medians. The contact-force error is taken over landings
against converged C MuJoCo, because quiet standing hides it.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import platform
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial

from dcc_jax import runtime

# Compile times are measured: cold means an empty cache.
runtime.ensure(cache_dir=tempfile.mkdtemp())

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, NamedSharding, PartitionSpec  # noqa: E402
from mujoco import mjx  # noqa: E402

from dcc_jax import physics  # noqa: E402
from dcc_jax.character import compose_scene, load_character  # noqa: E402
from dcc_jax.control import compliance, pd  # noqa: E402

Array = jax.Array
STEPS = 48  # physics steps a measured call


def standing_states(scene: physics.Scene, count: int) -> physics.State:
    """Slightly different characters standing on their soles, [count, ...]."""
    keys = jax.random.split(jax.random.key(0), count)
    qpos0 = jnp.asarray(scene.model.qpos0, jnp.float32)

    def one(key: Array) -> physics.State:
        qvel = 0.01 * jax.random.normal(key, (scene.model.nv,))
        return physics.initial_state(scene, qpos0, qvel)

    return jax.vmap(one)(keys)


def torque(scene: physics.Scene, state: physics.State) -> Array:
    """Stable PD towards the T-pose, [nv]."""
    q = scene.character_qpos(state.qpos)
    qd = scene.character_qvel(state.qvel)
    target = jnp.asarray(scene.model.qpos0, q.dtype)
    return scene.scatter_character(
        pd.torque(scene.character, q, qd, target, scene.timestep)
    )


def our_step(
    scene: physics.Scene, forces: int, carry: tuple, _: None
) -> tuple[tuple, None]:
    """One physics step, with the compliance step of Alg. 1 for `forces` forces."""
    state, displacement = carry
    kin = physics.kinematics(scene, state)
    solution = physics.solve(scene, kin, state, torque(scene, state))
    if forces:
        displacement = displaced(scene, kin, solution, displacement, forces)
    return (physics.integrate(scene, state, solution), displacement), None


def displaced(
    scene: physics.Scene,
    kin: physics.Kinematics,
    solution: physics.Solution,
    displacement: compliance.Displacement,
    forces: int,
) -> compliance.Displacement:
    """Alg. 1 with the forces of the first contact slots."""
    bodies = jnp.asarray(scene.contact_bodies[:forces, 1])
    force = solution.contact_force_w[:forces]
    J = jax.vmap(lambda p, b: physics.point_jacobian(scene, kin, p, b))(
        solution.contact_point_w[:forces], bodies
    )
    controller = compliance.Controller(
        compliance.ComplianceConfig(),
        scene.coords,
        scene.character.column_weight,
        scene.timestep,
    )
    return compliance.algorithm_1(
        controller,
        displacement,
        J,
        force,
        jnp.asarray(0.16),
        lambda qfrc: physics.mass_solve(scene, kin, qfrc),
    )


def sharded(step: Callable, carry: object) -> tuple[Callable, float]:
    """`STEPS` steps over all devices, compiled; and the seconds that took."""
    mesh = Mesh(np.array(jax.devices()), ("env",))
    spec = PartitionSpec("env")

    def chunk(carry: object) -> object:
        return jax.vmap(lambda c: jax.lax.scan(step, c, None, length=STEPS)[0])(carry)

    mapped = jax.shard_map(
        chunk, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )
    carry = jax.device_put(carry, NamedSharding(mesh, spec))
    begin = time.perf_counter()
    compiled = jax.jit(mapped).lower(carry).compile()
    return (
        lambda: jax.block_until_ready(compiled(carry)),
        time.perf_counter() - begin,
    )


def ours(scene: physics.Scene, count: int, forces: int) -> tuple[Callable, float]:
    """Our step over `count` environments."""
    rest = compliance.at_rest(scene.coords)
    rest = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), rest)
    carry = (standing_states(scene, count), rest)
    return sharded(partial(our_step, scene, forces), carry)


def naive(scene: physics.Scene, count: int) -> tuple[Callable, float]:
    """`vmap(mjx.step)` with the whole `mjx.Data` carried and MJX's own solver."""
    model = copy.copy(scene.model)
    model.opt.iterations, model.opt.ls_iterations = 4, 8
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    device_model = mjx.put_model(model)
    states = standing_states(scene, count)
    data = jax.vmap(
        lambda s: mjx.make_data(device_model).replace(qpos=s.qpos, qvel=s.qvel)
    )(states)

    def step(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
        state = physics.State(data.qpos, data.qvel, data.qacc)
        data = data.replace(qfrc_applied=torque(scene, state))
        return mjx.step(device_model, data), None

    return sharded(step, data)


def c_rollout(scene: physics.Scene, count: int, threads: int) -> Callable:
    """C MuJoCo stepping as many environments on `threads` threads."""
    model = scene.model
    states = standing_states(scene, count)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros((count, mujoco.mj_stateSize(model, full)))
    initial[:, 1 : 1 + model.nq] = states.qpos
    initial[:, 1 + model.nq : 1 + model.nq + model.nv] = states.qvel
    # The same torques as ours at the start of the call, held for its 0.2 s.
    held = np.asarray(jax.vmap(partial(torque, scene))(states), float)
    control = np.repeat(held[:, None], STEPS, axis=1)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def run() -> None:
        pool.rollout(
            [model] * count,
            datas,
            initial,
            control,
            control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED),
        )

    return run


def rates(variants: dict[str, tuple[Callable, int]], rounds: int) -> dict[str, float]:
    """Median steps per second of each variant; they take turns."""
    for run, _ in variants.values():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(rounds):
        for name, (run, _) in variants.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {
        name: variants[name][1] * STEPS / statistics.median(times)
        for name, times in seconds.items()
    }


def landing_errors(scene: physics.Scene, drops: int) -> dict[str, float]:
    """Relative error of each foot's force and of the impulse, against converged C.

    Characters fall from 0.3 m in slightly different poses; ours and C start from the
    same state in every step of the first 0.2 s after touchdown.
    """
    model = scene.model
    feet = [scene.body(name) for name in ("left_foot", "right_foot")]
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (drops, 1))
    for row in qpos:
        tangent = np.r_[0, 0, 0.3, 0.1 * rng.normal(size=model.nv - 3)]
        mujoco.mj_integratePos(model, row, tangent, 1.0)
    states = jax.vmap(lambda q: physics.initial_state(scene, q, jnp.zeros(model.nv)))(
        jnp.asarray(qpos, jnp.float32)
    )

    @jax.jit
    @jax.vmap
    def step(state: physics.State) -> tuple:
        kin = physics.kinematics(scene, state)
        qfrc = torque(scene, state)
        solution = physics.solve(scene, kin, state, qfrc)
        return physics.integrate(scene, state, solution), solution, qfrc

    data = mujoco.MjData(model)
    model.opt.iterations, model.opt.tolerance = 100, 1e-12
    since = np.full(drops, -1)
    errors, ours_sum, theirs_sum = [], np.zeros((drops, 2)), np.zeros((drops, 2))
    for _ in range(int(0.75 / scene.timestep)):
        following, solution, qfrc = step(states)
        force = np.asarray(solution.contact_force_w)
        for i in range(drops):
            data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
            data.qfrc_applied[:] = qfrc[i]
            mujoco.mj_forward(model, data)
            theirs = _foot_forces(model, data, feet)
            since[i] += int(since[i] >= 0 or theirs.any())
            if not 0 <= since[i] < 0.2 / scene.timestep:
                continue
            slots = [scene.contact_bodies[:, 1] == foot for foot in feet]
            mine = np.array([force[i, slot].sum(axis=0) for slot in slots])
            size = np.linalg.norm(theirs, axis=1)
            gap = np.linalg.norm(mine - theirs, axis=1)
            errors += list((gap / np.maximum(size, 1.0))[size > 1.0])
            ours_sum[i] += np.linalg.norm(mine, axis=1)
            theirs_sum[i] += size
        states = following
    landed = theirs_sum > 0.0
    impulse = np.abs(ours_sum - theirs_sum)[landed] / theirs_sum[landed]
    return {
        "force_error_median": float(np.median(errors)),
        "force_error_p95": float(np.percentile(errors, 95)),
        "force_error_max": float(np.max(errors)),
        "impulse_error_median": float(np.median(impulse)),
    }


def _foot_forces(
    model: mujoco.MjModel, data: mujoco.MjData, feet: list[int]
) -> np.ndarray:
    """World force [2, 3] of the floor on each foot."""
    total, local = np.zeros((2, 3)), np.zeros(6)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, local)
        foot = feet.index(model.geom_bodyid[data.contact[i].geom2])
        total[foot] += data.contact[i].frame.reshape(3, 3).T @ local[:3]
    return total


def main() -> None:
    """Parses the arguments, measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", help="write the numbers to this file")
    parser.add_argument("--quick", action="store_true", help="few rounds and drops")
    args = parser.parse_args()
    rounds, drops = (3, 4) if args.quick else (11, 16)
    character = load_character()
    scene = physics.make_scene(compose_scene(character), character)
    gpu = jax.default_backend() != "cpu"
    counts = (1024, 4096, 8192, 16384, 32768) if gpu else (128 * len(jax.devices()),)
    threads = len(os.sched_getaffinity(0))
    report: dict[str, object] = {
        "device": f"{len(jax.devices())} x {jax.devices()[0].device_kind}",
        "machine": f"{platform.machine()}, {threads} cores",
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "newton_iterations": scene.newton_iterations,
    }
    for count in counts:
        plain, compile_cold = ours(scene, count, 0)
        jax.clear_caches()
        _, compile_warm = ours(scene, count, 0)
        variants = {
            "c_1_thread": (c_rollout(scene, count, 1), count),
            "c_all_threads": (c_rollout(scene, count, threads), count),
            "mjx_naive": (naive(scene, count)[0], count),
            "ours": (plain, count),
            "ours_compliance_1": (ours(scene, count, 1)[0], count),
            "ours_compliance_2": (ours(scene, count, 2)[0], count),
        }
        measured = rates(variants, rounds)
        suffix = f"_{count}" if gpu else ""
        for name, rate in measured.items():
            report[name + suffix] = round(rate, 1)
        c_all = measured["c_all_threads"]
        report["ratio_ours_c_all" + suffix] = round(measured["ours"] / c_all, 3)
        report["compile_cold_s"] = round(compile_cold, 2)
        report["compile_warm_s"] = round(compile_warm, 2)
    report |= landing_errors(scene, drops)
    report["peak_memory_mib"] = (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    )
    for name, value in report.items():
        print(f"{name:24s} {value}")
    if args.json:
        with open(args.json, "w") as file:
            json.dump(report, file, indent=2)


if __name__ == "__main__":
    main()
