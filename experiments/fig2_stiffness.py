"""Fig. 2: how far 50 N take the left hand in every direction, for three poses.

The shells are to scale: the inner one is where PD alone holds the hand, K^-1 f, the
outer one where the compliance controller with a measured velocity does, K_hat^-1 f.

    python experiments/fig2_stiffness.py [--out FILE.png] [--alpha 0.5]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from mpl_toolkits.mplot3d import Axes3D

from dcc_jax import command
from dcc_jax.character import load_character
from dcc_jax.control.stiffness import (
    determinant,
    ellipsoid,
    modulated_stiffness,
    stiffness,
)

FORCE = 50.0  # N
PALM = (0.0, 0.085, 0.0)  # m, in the hand's frame
POSES = {
    "straight": {},
    "elbow bent by 45 degrees": {"left_elbow": (0.0, 0.0, -0.785)},
    "elbow bent by 90 degrees": {"left_elbow": (0.0, 0.0, -1.571)},
}


def posed(model: mujoco.MjModel, joints: dict[str, tuple[float, ...]]) -> np.ndarray:
    """Coordinates with the named joints turned by rotation vectors in rad."""
    qpos, tangent = model.qpos0.copy(), np.zeros(model.nv)
    for name, vector in joints.items():
        start = model.joint(name).dofadr[0]
        tangent[start : start + 3] = vector
    mujoco.mj_integratePos(model, qpos, tangent, 1.0)
    return qpos


def draw_character(axes: Axes3D, model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Draws the bones; returns where the palm is, [3]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    for body in range(2, model.nbody):
        ends = data.xpos[[model.body_parentid[body], body]]
        axes.plot(*ends.T, color="0.45", lw=3, solid_capstyle="round")
    hand = data.body("left_hand")
    palm = hand.xpos + hand.xmat.reshape(3, 3) @ np.array(PALM)
    axes.plot(*np.array([hand.xpos, palm]).T, color="0.45", lw=3)
    head = data.body("head")
    axes.scatter(*(head.xpos + np.array([0.02, 0.0, 0.14])), color="0.45", s=220)
    return palm


def draw_shell(axes: Axes3D, centre: np.ndarray, K: np.ndarray, **style) -> None:
    """Where the forces of `FORCE` N take the point: the ellipsoid K^-1 f."""
    principal, stiffnesses = ellipsoid(K)
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 33j, 0 : np.pi : 17j]
    sphere = np.stack(
        [
            np.cos(longitude) * np.sin(latitude),
            np.sin(longitude) * np.sin(latitude),
            np.cos(latitude),
        ],
        axis=-1,
    )
    shell = centre + (sphere * FORCE / stiffnesses) @ principal.T
    axes.plot_surface(*np.moveaxis(shell, -1, 0), **style)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/fig2_stiffness.png"))
    parser.add_argument("--alpha", type=float, default=0.5)
    options = parser.parse_args()
    if not 0.0 <= options.alpha < 1.0:
        parser.error(f"argument --alpha: must be in [0, 1), got {options.alpha}")
    character = load_character()
    model = character.spec().compile()
    figure = plt.figure(figsize=(13, 4.8))
    for column, (name, joints) in enumerate(POSES.items(), 1):
        axes = figure.add_subplot(1, 3, column, projection="3d")
        qpos = posed(model, joints)
        K = stiffness(model, qpos, "left_hand", PALM, character.kp)
        palm = draw_character(axes, model, qpos)
        K_hat = modulated_stiffness(K, options.alpha)
        draw_shell(axes, palm, K, color="tab:blue", alpha=0.9, lw=0)
        draw_shell(axes, palm, K_hat, color="tab:orange", alpha=0.25, lw=0)
        _, principal = ellipsoid(K)
        numbers = " / ".join(f"{k:.0f}" for k in principal)
        axes.set_title(f"{name}\n{numbers} N/m along the axes", fontsize=10)
        axes.set(xlim=(-0.3, 0.7), ylim=(-0.1, 0.9), zlim=(0.8, 1.8))
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=28, azim=-35)
        ratio = determinant(K_hat) / determinant(K)
        print(f"{name}: K = {numbers} N/m, det K_hat / det K = {ratio:.4f}")
    figure.suptitle(
        f"Where {FORCE:.0f} N take the left hand: PD (blue), "
        f"with compliance alpha = {options.alpha} (orange)"
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)
    print(options.out)


if __name__ == "__main__":
    command.script(main)
