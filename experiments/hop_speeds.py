"""How well a policy of `chicken-fight` hops where its reference goes, and how high.

    python experiments/hop_speeds.py chicken-fight [--episodes 256] [--seconds 10]

Each episode has one speed, in a direction of its own, and nobody attacks: where the box
is touched all the same, it says so and gives up. The second half of it is measured: the
velocity along the path in means of a second, how far the root is from the path's, hops
a second from the first to the last of them, and how long the lowest point of the
hopping foot's sole is more than 3 cm up, beside the clips' own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

import jax
import mujoco
import numpy as np
from commanded import played, steady, straight

from dcc_jax import physics
from dcc_jax.character import CONTROL_RATE, asset_path, compose_scene, load_character
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import RefState
from dcc_jax.tasks.chicken_fight import ChickenFight, ChickenFightState

SPEEDS = (0.0, 0.2, 0.4)  # m/s
SIDES = ("ahead", "left", "back", "right")
UP = 0.03  # m


@dataclass(frozen=True)
class Commanded(ChickenFight):
    """One speed for the whole episode, straight on."""

    name: ClassVar[str] = "commanded-hops"

    def reset(
        self, key: jax.Array, scene: physics.Scene, reference: RefState
    ) -> tuple[ChickenFightState, jax.Array, jax.Array]:
        """As ever, and then it wants one of the speeds."""
        speed_key, key = jax.random.split(key)
        state, qpos, qvel = super().reset(key, scene, reference)
        motion = steady(speed_key, state.motion, SPEEDS)
        return dataclasses.replace(state, motion=motion), qpos, qvel

    def evaluate(
        self, scene: physics.Scene, state: ChickenFightState, body: physics.State
    ) -> dict[str, jax.Array]:
        """Also what is wanted: speed in m/s and heading in rad."""
        return super().evaluate(scene, state, body) | {
            "wanted": state.motion.wanted_speed,
            "heading": state.motion.heading,
        }


def airborne(qpos: np.ndarray) -> np.ndarray:
    """Whether the left sole is up in each pose [..., 55]."""
    model = compose_scene(load_character(), floor=False)
    data = mujoco.MjData(model)
    soles = [
        i for i in range(model.ngeom) if model.geom(i).name.startswith("left_sole")
    ]
    height = []
    for q in qpos.reshape(-1, model.nq):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        height.append(np.min(data.geom_xpos[soles, 2] - model.geom_size[soles, 0]))
    return np.reshape(height, qpos.shape[:-1]) > UP


def cadence(up: np.ndarray) -> float:
    """Hops a second, from the first to the last of them, of what is up or not [T]."""
    leaves = np.flatnonzero(up[1:] & ~up[:-1])
    if len(leaves) < 2:
        return 0.0
    return CONTROL_RATE * (len(leaves) - 1) / float(leaves[-1] - leaves[0])


def main() -> None:
    """Parses the arguments, plays, prints."""
    recording, scene = played(
        __doc__ or "",
        ChickenFight,
        lambda task: Commanded(gaits=straight(task.gaits)).quiet(),
    )
    assert recording.motion is not None
    if recording.numbers["task/bump_force_peak"].max() > 1.0:
        raise SystemExit("the box was touched")
    half = recording.alive.shape[0] // 2
    qpos = np.array(scene.character_qpos(recording.motion.qpos))[half:]
    wanted = recording.numbers["task/wanted"][-1]
    heading = recording.numbers["task/heading"][half:]
    away = recording.numbers["task/path_distance"][half:]
    along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)[:-CONTROL_RATE]
    covered = qpos[CONTROL_RATE:, :, :2] - qpos[:-CONTROL_RATE, :, :2]
    speed = np.sum(covered * along, axis=-1)
    clips = [
        load_clip(asset_path(f"motions/{name}.npz")).qpos for name in Commanded.clips
    ]
    up = airborne(qpos)
    side = np.round(heading[-1] / (0.5 * np.pi)).astype(int) % 4
    whole = recording.alive.all(axis=0) & ~recording.fell
    print("| wanted, m/s | to | episodes | falls | mean speed, m/s ", end="")
    print("| rms error, m/s | from the path, m | hops/s | sole up | clips' |")
    print("|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for goal in SPEEDS:
        own = airborne(clips[0] if goal == 0.0 else clips[1]).mean()
        for i, name in enumerate(SIDES) if goal else [(0, "-")]:
            mine = np.isclose(wanted, goal) & ((side == i) | (goal == 0.0))
            stays = mine & whole
            error = np.sqrt(np.mean((speed[:, stays] - goal) ** 2))
            mean, apart = speed[:, stays].mean(), away[:, stays].mean()
            falls, high = recording.fell[mine].mean(), up[:, stays].mean()
            hops = np.mean([cadence(feet) for feet in up[:, stays].T])
            print(
                f"| {goal:g} | {name} | {mine.sum()} | {falls:.0%} "
                f"| {mean:.2f} | {error:.2f} | {apart:.2f} "
                f"| {hops:.2f} | {high:.0%} | {own:.0%} |"
            )


if __name__ == "__main__":
    command.script(main)
