"""What the compliance controller does before any learning: a map of pushes.

180 N push each of the 15 bodies, at its centre of mass, along +-x, +-y and +-z, for
0.5 s; then u returns for 0.5 s. The character stands on the floor, stable PD follows
q_m (+) u, and gravity acts. Its pelvis is held in place by a stiff spring-damper to the
world, so that one sees the controller and not a fall; the dynamics the controller
itself looks at, M^-1 J^T f, remain those of the free character.

    python experiments/compliance_map.py [--out DIR] [--force 180]

One figure an estimator: a pair of panels a body, the joints' |log u| and the root's
displacement over time, the mean over the six directions in a line for every level of
compliance, their extremes in a band. `compliance_map.json` holds the peaks.
"""

from __future__ import annotations

from dcc_jax import runtime

if __name__ == "__main__":
    runtime.ensure()

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import mujoco
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from dcc_jax import physics, quat
from dcc_jax.character import BODIES, Character, compose_scene, load_character
from dcc_jax.control import compliance, pd

LEVELS = (0.0, 0.04, 0.08, 0.16)
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
PUSH_SECONDS, SECONDS = 0.5, 1.0
HOLD = np.array([3e4] * 3 + [3e3] * 3)  # N/m and N m/rad, of the pelvis to the world
HOLD_DAMPING = np.array([2e3] * 3 + [2e2] * 3)  # N s/m and N m s/rad
ARMS_DOWN = {"left_shoulder": (-1.2, 0.0, 0.0), "right_shoulder": (1.2, 0.0, 0.0)}

Array = jax.Array


def standing(model: mujoco.MjModel) -> np.ndarray:
    """Standing with the arms down, qpos [nq]."""
    qpos, tangent = model.qpos0.copy(), np.zeros(model.nv)
    for name, vector in ARMS_DOWN.items():
        start = model.joint(name).dofadr[0]
        tangent[start : start + 3] = vector
    mujoco.mj_integratePos(model, qpos, tangent, 1.0)
    return qpos


def pushed(scene: physics.Scene, config: compliance.ComplianceConfig):
    """A function (body, force [3], alpha) -> log u [T, 42] of one simulated push."""
    character, h = scene.character, scene.timestep
    q_m = jnp.asarray(standing(scene.model), jnp.float32)
    controller = compliance.Controller(config, scene.coords, character.column_weight, h)
    centre = jnp.asarray(scene.model.body_ipos, jnp.float32)

    def step(carry, time, body, force, alpha):
        state, displacement = carry
        kin = physics.kinematics(scene, state)
        point = kin.body_pos[body] + quat.rotate(kin.body_quat[body], centre[body])
        J = physics.point_jacobian(scene, kin, point, body)
        f = jnp.where(time < PUSH_SECONDS, force, 0.0)
        given = controller, displacement, J[None], f[None], alpha
        if config.velocity == "measured":
            displacement = compliance.measured(*given, (J @ state.qvel)[None])
        else:
            displacement = compliance.algorithm_1(
                *given, lambda qfrc: physics.mass_solve(scene, kin, qfrc)
            )
        q_bar = quat.oplus(scene.coords, q_m, displacement.u)
        qfrc = pd.torque(character, state.qpos, state.qvel, q_bar, h) + J.T @ f
        qfrc = qfrc + held(q_m, state, h)
        state = physics.integrate(scene, state, physics.solve(scene, kin, state, qfrc))
        return (state, displacement), quat.log_map(scene.coords, displacement.u)

    def simulate(body: Array, force: Array, alpha: Array) -> Array:
        start = physics.initial_state(scene, q_m, jnp.zeros(scene.model.nv))
        times = jnp.arange(round(SECONDS / h)) * h
        carry = (start, compliance.at_rest(scene.coords))
        _, u = jax.lax.scan(
            lambda carry, time: step(carry, time, body, force, alpha), carry, times
        )
        return u

    return simulate


def held_scene(character: Character) -> physics.Scene:
    """The character on the floor, the pelvis's spring-damper implicit like stable PD.

    Its share h D + h^2 K of the diagonal is left out of what `physics.mass_solve` sees.
    """
    model = compose_scene(character)
    h, extra = model.opt.timestep, np.zeros(model.nv)
    extra[:6] = h * HOLD_DAMPING + h * h * HOLD
    model.dof_armature += extra
    scene = physics.make_scene(model, character)
    return dataclasses.replace(scene, spd_diagonal=scene.spd_diagonal + extra)


def held(q_m: Array, state: physics.State, h: float) -> Array:
    """Generalized force [nv] of the spring-damper that holds the pelvis."""
    turn = quat.log(quat.mul(quat.inv(state.qpos[3:7]), q_m[3:7]))
    error = jnp.concatenate([q_m[:3] - state.qpos[:3], turn])
    root = state.qvel[:6]
    force = HOLD * (error - h * root) - HOLD_DAMPING * root
    return jnp.zeros_like(state.qvel).at[:6].set(force.astype(state.qvel.dtype))


def pushes(newtons: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Body ids, forces and levels of every combination, in C order."""
    bodies, directions, levels = np.meshgrid(
        np.arange(1, 16), np.arange(6), np.arange(len(LEVELS)), indexing="ij"
    )
    return (
        bodies.ravel(),
        newtons * DIRECTIONS[directions.ravel()],
        np.array(LEVELS)[levels.ravel()],
    )


def simulate_all(scene: physics.Scene, velocity: str, newtons: float) -> np.ndarray:
    """log u [15 bodies, 6 directions, 4 levels, T, 42]."""
    config = compliance.ComplianceConfig(velocity=velocity)
    one = pushed(scene, config)
    bodies, forces, levels = (jnp.asarray(x) for x in pushes(newtons))
    run = jax.jit(
        lambda *arguments: jax.lax.map(lambda a: one(*a), arguments, batch_size=60)
    )
    u = np.asarray(run(bodies, forces.astype(jnp.float32), levels.astype(jnp.float32)))
    return u.reshape(15, 6, len(LEVELS), *u.shape[1:])


def draw(u: np.ndarray, velocity: str, newtons: float, out: Path) -> None:
    """The map of one estimator."""
    joints = np.degrees(np.linalg.norm(u[..., 6:], axis=-1))
    root = 100.0 * np.linalg.norm(u[..., :3], axis=-1)
    time = np.linspace(0.0, SECONDS, u.shape[-2])
    figure, grid = plt.subplots(
        5, 6, figsize=(16, 11), sharex=True, layout="constrained"
    )
    for body, name in enumerate(BODIES):
        row, column = body // 3, 2 * (body % 3)
        for axes, values in (
            (grid[row, column], joints),
            (grid[row, column + 1], root),
        ):
            for level, alpha in enumerate(LEVELS):
                runs, color = values[body, :, level], f"C{level}"
                axes.plot(time, runs.mean(axis=0), color=color, label=f"alpha {alpha}")
                axes.fill_between(
                    time, runs.min(axis=0), runs.max(axis=0), color=color, alpha=0.12
                )
            axes.axvline(PUSH_SECONDS, color="0.7", lw=0.8)
            axes.set_ylim(bottom=0.0)
        grid[row, column].set_title(f"{name}: joints, degrees", fontsize=9)
        grid[row, column + 1].set_title(f"{name}: root, cm", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    grid[0, 0].legend(fontsize=8)
    figure.suptitle(
        f"|log u| under {newtons:.0f} N for {PUSH_SECONDS} s on each body, six "
        f"directions (mean and extremes), velocity = {velocity}; pelvis held"
    )
    figure.savefig(out / f"compliance_map_{velocity}.png", dpi=80)
    plt.close(figure)


def peaks(u: np.ndarray) -> list[dict[str, object]]:
    """The largest displacement of every push."""
    joints = np.degrees(np.linalg.norm(u[..., 6:], axis=-1)).max(axis=-1)
    root = np.linalg.norm(u[..., :3], axis=-1).max(axis=-1)
    return [
        {
            "body": BODIES[body],
            "direction": DIRECTIONS[direction].tolist(),
            "alpha": LEVELS[level],
            "joints_deg": round(float(joints[body, direction, level]), 4),
            "root_m": round(float(root[body, direction, level]), 5),
        }
        for body, direction, level in np.ndindex(*joints.shape)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/compliance_map"))
    parser.add_argument("--force", type=float, default=180.0, help="N")
    options = parser.parse_args()
    if not 0.0 < options.force < np.inf:
        parser.error(f"argument --force: must be positive, got {options.force}")
    options.out.mkdir(parents=True, exist_ok=True)
    character = load_character()
    scene = held_scene(character)
    rows = {}
    for velocity in ("forward_dynamics", "measured"):
        u = simulate_all(scene, velocity, options.force)
        draw(u, velocity, options.force, options.out)
        rows[velocity] = peaks(u)
        largest = max(row["joints_deg"] for row in rows[velocity])
        print(f"{velocity}: finite {np.isfinite(u).all()}, largest {largest} degrees")
    (options.out / "compliance_map.json").write_text(json.dumps(rows, indent=1))
    print(options.out)


if __name__ == "__main__":
    main()
