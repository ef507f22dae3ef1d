"""How well a policy of `chicken-fight` hops where its reference goes, and how high.

    python experiments/hop_speeds.py chicken-fight [--episodes 96] [--seconds 10]

Each episode has one speed, in a direction of its own, and nobody attacks: where the box
is touched all the same, it says so and gives up. The second half of it is measured: the
velocity along the path in means of a second, how far the root is from the path's, and
how long the lowest point of the hopping foot's sole is more than 3 cm up, beside the
clips' own.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from dcc_jax import runtime

if __name__ == "__main__":
    runtime.ensure()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics
from dcc_jax.character import CONTROL_RATE, asset_path, compose_scene, load_character
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import RefState
from dcc_jax.play.player import Player
from dcc_jax.play.runs import find_run, make_environment
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
        speed = jax.random.choice(speed_key, jnp.array(SPEEDS))
        forever = jnp.asarray(1e6)
        motion = dataclasses.replace(state.motion, wanted_speed=speed, left=forever)
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


def main() -> None:
    """Parses the arguments, plays, prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_DIR|NAME")
    add("--episodes", type=int, default=256)
    add("--seconds", type=float, default=10.0)
    add("--alpha", type=float, default=0.0)
    add("--seed", type=int, default=0)
    options = parser.parse_args()
    run = find_run(options.run)
    task = run.config.task
    if not isinstance(task, ChickenFight):
        parser.error(f"{options.run} is a policy of {task.name}")
    straight = dataclasses.replace(task.gaits, turn_rate=0.0)
    player = Player(make_environment(run, Commanded(gaits=straight).quiet()))
    recording = player.play(
        run,
        np.arange(options.episodes),
        np.full(options.episodes, options.alpha),
        seed=options.seed,
        seconds=options.seconds,
        motion=True,
    )
    assert recording.motion is not None
    half = recording.alive.shape[0] // 2
    qpos = np.array(player.environment.scene.character_qpos(recording.motion.qpos))
    qpos = qpos[half:]
    wanted = recording.numbers["task/wanted"][-1]
    heading = recording.numbers["task/heading"][half:]
    away = recording.numbers["task/path_distance"][half:]
    along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)[:-CONTROL_RATE]
    covered = qpos[CONTROL_RATE:, :, :2] - qpos[:-CONTROL_RATE, :, :2]
    speed = np.sum(covered * along, axis=-1)
    if recording.numbers["task/bump_force_peak"].max() > 1.0:
        parser.exit(1, "the box was touched\n")
    clips = [load_clip(asset_path(f"motions/{name}.npz")).qpos for name in task.clips]
    up = airborne(qpos)
    side = np.round(heading[-1] / (0.5 * np.pi)).astype(int) % 4
    whole = recording.alive.all(axis=0) & ~recording.fell
    print("| wanted, m/s | to | episodes | falls | mean speed, m/s ", end="")
    print("| rms error, m/s | from the path, m | sole up | clips' |")
    print("|--:|---|--:|--:|--:|--:|--:|--:|--:|")
    for goal in SPEEDS:
        own = airborne(clips[0] if goal == 0.0 else clips[1]).mean()
        for i, name in enumerate(SIDES) if goal else [(0, "-")]:
            mine = np.isclose(wanted, goal) & ((side == i) | (goal == 0.0))
            stays = mine & whole
            error = np.sqrt(np.mean((speed[:, stays] - goal) ** 2))
            mean, apart = speed[:, stays].mean(), away[:, stays].mean()
            falls = recording.fell[mine].mean()
            print(
                f"| {goal:g} | {name} | {mine.sum()} | {falls:.0%} "
                f"| {mean:.2f} | {error:.2f} | {apart:.2f} "
                f"| {up[:, stays].mean():.0%} | {own:.0%} |"
            )


if __name__ == "__main__":
    main()
