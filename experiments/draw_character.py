"""Draws `docs/character.png`: the character in its zero pose and in motion."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from matplotlib.image import imsave
from scipy.spatial.transform import Rotation

from dcc_jax import command
from dcc_jax.character import asset_path, compose_scene, load_character
from dcc_jax.motion.clip import load_clip
from dcc_jax.viz import draw

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "character.png"
POSES = (
    ("stand", 0.0, 0.35),
    ("walk", 3.97, 0.9),
    ("run_cycle", 0.13, 0.9),
    ("jump", 1.53, 0.7),
)  # clip, time in s, turned to the left by rad
SPACING = 1.05  # m
VIEW = draw.View(
    azimuth=180.0,
    elevation=-6.0,
    distance=3.2,
    height=0.95,
    body=None,
    target=(0.0, 2.0 * SPACING),
)


def crowd(count: int) -> mujoco.MjModel:
    """`count` characters in one world."""
    character = load_character()

    def extend(spec: mujoco.MjSpec) -> None:
        for index in range(1, count):
            frame = spec.worldbody.add_frame()
            spec.attach(character.spec(), prefix=f"other{index}_", frame=frame)

    return compose_scene(character, extend=extend)


def main() -> None:
    """Writes the picture."""
    zero = np.zeros(55)
    zero[2], zero[3::4] = load_character().stand_height, 1.0
    poses = [zero]
    for name, time, turn in POSES:
        clip = load_clip(asset_path(f"motions/{name}.npz"))
        pose = clip.qpos[round(time * clip.fps)].astype(float)
        facing = Rotation.from_quat(pose[3:7], scalar_first=True)
        facing = Rotation.from_euler("z", turn) * facing
        pose[3:7] = facing.as_quat(scalar_first=True)
        poses.append(pose)
    poses = [pose.copy() for pose in poses]
    for index, pose in enumerate(poses):
        pose[:2] = 0.0, SPACING * index - 0.35 * (index == 0)
    image = next(
        draw.frames(
            crowd(len(poses)),
            np.concatenate(poses)[None],
            camera=VIEW,
            size=(1200, 420),
        )
    )
    imsave(PICTURE, image)


if __name__ == "__main__":
    command.script(main)
