"""What the three laws of compliance do before any learning: a map of pushes.

A force pushes each of the 15 bodies, at its centre of mass, along +-x, +-y and +-z, for
two seconds; then u returns for one. The character stands on the floor, stable PD
follows q_m (+) u, and gravity acts. Its pelvis is held in place by a stiff
spring-damper to the world, so that one sees the controller and not a fall.

    python experiments/compliance_map.py [--out DIR] [--force 100] [--alpha 0.5]

One figure: a pair of panels a body, the joints' |log u| and how far the point that is
pushed moves, over time. A line a law, the mean over the six directions; grey is PD
alone, alpha 0. `compliance_map.json` holds u and yield at the end of every push.
"""

from __future__ import annotations

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

import argparse
import dataclasses
import json
from pathlib import Path
from typing import cast

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
from dcc_jax.control.config import LAWS, ComplianceConfig, Law

PD_ALONE = "PD alone"
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
PUSH_SECONDS, SECONDS = 2.0, 3.0
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


def pushed(scene: physics.Scene, config: ComplianceConfig):
    """A function (body, force [3], alpha) -> log u [T, 42], point [T, 3] of a push."""
    character, h = scene.character, scene.timestep
    q_m = jnp.asarray(standing(scene.model), jnp.float32)
    controller = compliance.Controller.of(config, character, scene.coords, h)
    room = controller.room(q_m)
    centre = jnp.asarray(scene.model.body_ipos, jnp.float32)

    def step(carry, time, body, force, alpha):
        state, displacement = carry
        kin = physics.kinematics(scene, state)
        point = kin.body_pos[body] + quat.rotate(kin.body_quat[body], centre[body])
        J = physics.point_jacobian(scene, kin, point, body)
        f = force * (time < PUSH_SECONDS)
        given = controller, displacement, J[None], f[None], alpha, room
        if config.law == "admittance":
            displacement = compliance.admittance(
                controller, displacement, f @ J, alpha, room
            )
        elif config.law == "measured":
            displacement = compliance.measured(*given, jnp.matmul(J, state.qvel)[None])
        else:
            displacement = compliance.algorithm_1(
                *given, lambda qfrc: physics.mass_solve(scene, kin, qfrc)
            )
        q_bar = quat.oplus(scene.coords, q_m, displacement.u)
        qfrc = pd.torque(character, state.qpos, state.qvel, q_bar, h) + jnp.matmul(
            J.T, f
        )
        qfrc = qfrc + held(q_m, state, h)
        state = physics.integrate(scene, state, physics.solve(scene, kin, state, qfrc))
        u = quat.log_map(scene.coords, displacement.u)
        return (state, displacement), (u, point)

    def simulate(body: Array, force: Array, alpha: Array) -> tuple[Array, Array]:
        start = physics.initial_state(scene, q_m, jnp.zeros(scene.model.nv))
        times = jnp.arange(round(SECONDS / h)) * h
        carry = (start, compliance.at_rest(scene.coords))
        _, seen = jax.lax.scan(
            lambda carry, time: step(carry, time, body, force, alpha), carry, times
        )
        return seen

    return simulate


def held_scene(character: Character) -> physics.Scene:
    """The character on the floor, the pelvis's spring-damper implicit like stable PD.

    Its share h D + h^2 K of the diagonal is left out of what `physics.mass_solve` sees:
    the dynamics that Alg. 1 looks at are those of the free character.
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


def simulate_all(
    scene: physics.Scene, law: str, newtons: float, alpha: float
) -> tuple[np.ndarray, np.ndarray]:
    """|log u| of the joints, degrees, and the point's way, m, [15 bodies, 6, T]."""
    one = pushed(scene, ComplianceConfig(law=cast(Law, law)))
    bodies, directions = np.meshgrid(np.arange(1, 16), np.arange(6), indexing="ij")
    forces = newtons * DIRECTIONS[directions.ravel()]
    run = jax.jit(
        lambda bodies, forces: jax.lax.map(
            lambda a: one(a[0], a[1], jnp.asarray(alpha)),
            (bodies, forces),
            batch_size=45,
        )
    )
    u, point = run(jnp.asarray(bodies.ravel()), jnp.asarray(forces, jnp.float32))
    u, point = (np.asarray(x).reshape(15, 6, *x.shape[1:]) for x in (u, point))
    way = np.linalg.norm(point - point[:, :, :1], axis=-1)
    return np.degrees(np.linalg.norm(u[..., 6:], axis=-1)), way


def draw(found: dict[str, tuple[np.ndarray, np.ndarray]], title: str, out: Path):
    """The map."""
    figure, grid = plt.subplots(
        5, 6, figsize=(16, 11), sharex=True, layout="constrained"
    )
    for body, name in enumerate(BODIES):
        row, column = body // 3, 2 * (body % 3)
        for law, (u, way) in found.items():
            color = "0.6" if law == PD_ALONE else f"C{LAWS.index(law)}"
            time = np.linspace(0.0, SECONDS, u.shape[-1])
            grid[row, column].plot(time, u[body].mean(axis=0), color=color, label=law)
            grid[row, column + 1].plot(
                time, 100.0 * way[body].mean(axis=0), color=color
            )
        grid[row, column].set_title(f"{name}: u, degrees", fontsize=9)
        grid[row, column + 1].set_title(f"{name}: yield, cm", fontsize=9)
    for axes in grid.flat:
        axes.axvline(PUSH_SECONDS, color="0.8", lw=0.8)
        axes.set_ylim(bottom=0.0)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    grid[0, 0].legend(fontsize=8)
    figure.suptitle(title)
    figure.savefig(out, dpi=80)
    plt.close(figure)


def rows(found: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[dict[str, object]]:
    """u and yield at the end of every push."""
    return [
        {
            "law": law,
            "body": BODIES[body],
            "direction": DIRECTIONS[direction].tolist(),
            "u_degrees": round(float(_at_the_end(u)[body, direction]), 3),
            "yield_m": round(float(_at_the_end(way)[body, direction]), 5),
        }
        for law, (u, way) in found.items()
        for body, direction in np.ndindex(15, 6)
    ]


def _at_the_end(course: np.ndarray) -> np.ndarray:
    """Of the push, of a course [..., T]."""
    return course[..., round(course.shape[-1] * PUSH_SECONDS / SECONDS) - 1]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/compliance_map"))
    parser.add_argument("--force", type=float, default=100.0, help="N")
    parser.add_argument("--alpha", type=float, default=0.5)
    options = parser.parse_args()
    if not 0.0 < options.force < np.inf:
        parser.error(f"argument --force: must be positive, got {options.force}")
    if not 0.0 < options.alpha <= ComplianceConfig(law="admittance").greatest_alpha:
        parser.error(f"argument --alpha: must be in (0, 0.9], got {options.alpha}")
    options.out.mkdir(parents=True, exist_ok=True)
    scene = held_scene(load_character())
    found = {
        law: simulate_all(scene, law, options.force, options.alpha) for law in LAWS
    }
    found[PD_ALONE] = simulate_all(scene, "admittance", options.force, 0.0)
    for law, (u, way) in found.items():
        hand = 100.0 * _at_the_end(way)[BODIES.index("left_hand")].mean()
        print(f"{law}: largest u {u.max():.1f} degrees, the hand yields {hand:.1f} cm")
    title = (
        f"{options.force:g} N for {PUSH_SECONDS:g} s on each body, alpha "
        f"{options.alpha:g}, mean over six directions; pelvis held"
    )
    draw(found, title, options.out / "compliance_map.png")
    (options.out / "compliance_map.json").write_text(json.dumps(rows(found), indent=1))
    print(options.out)


if __name__ == "__main__":
    command.script(main)
