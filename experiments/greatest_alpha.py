"""The greatest level of compliance at which a force is yielded to in full.

    python experiments/greatest_alpha.py --newtons 100 [--clip stand] [--body left_hand]

Beyond it some joint would use more than half of the room that its range leaves
(`control/ranges.py`), and the yield is shortened. A row a body, a column a direction,
the least over the poses of the clip; forces act at the centres of mass.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import command, quat
from dcc_jax.character import BODIES, asset_path, compose_scene, load_character
from dcc_jax.control import compliance
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.motion.clip import load_clip

DIRECTIONS = {
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}
POSES = 12


def levels(clip: str, body: str, newtons: float) -> np.ndarray:
    """The greatest alpha in each direction [6], the least over poses of a clip."""
    character = load_character()
    model = compose_scene(character, floor=False)
    coords = quat.Coordinates.of(model)
    controller = compliance.Controller.of(
        ComplianceConfig(law="admittance"), character, coords, 1 / 240
    )
    frames = load_clip(asset_path(f"motions/{clip}.npz")).qpos
    q = frames[np.linspace(0, len(frames) - 1, POSES).astype(int)]
    J = np.stack([jacobian(model, pose, body) for pose in q])
    forces = newtons * np.array(list(DIRECTIONS.values()), float)
    of_pose = jax.vmap(
        lambda q, J, f: compliance.greatest_alpha(controller, q, J[None], f[None]),
        (None, None, 0),
    )
    given = (jnp.asarray(x, jnp.float32) for x in (q, J, forces))
    return np.asarray(jax.jit(jax.vmap(of_pose, (0, 0, None)))(*given)).min(axis=0)


def jacobian(model: mujoco.MjModel, q: np.ndarray, body: str) -> np.ndarray:
    """J [3, nv] of a body's centre of mass."""
    data, J = mujoco.MjData(model), np.zeros((3, model.nv))
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    at = model.body(body).id
    mujoco.mj_jac(model, data, J, None, data.xipos[at], at)
    return J


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--newtons", type=float, default=100.0, help="size of the force"
    )
    parser.add_argument("--clip", default="stand", help="whose poses")
    parser.add_argument("--body", choices=BODIES, help="default: all")
    options = parser.parse_args()
    if not 0.0 < options.newtons < np.inf:
        parser.error(f"argument --newtons: must be positive, got {options.newtons}")
    try:
        asset_path(f"motions/{options.clip}.npz")
    except FileNotFoundError as error:
        parser.error(f"argument --clip: {error}")
    print(f"{'':16}" + "".join(f"{name:>9}" for name in DIRECTIONS))
    for body in [options.body] if options.body else BODIES:
        row = levels(options.clip, body, options.newtons)
        print(f"{body:16}" + "".join(f"{level:9.2f}" for level in row))


if __name__ == "__main__":
    command.script(main)
