"""How well a policy of `locomotion` keeps a commanded speed, and how it steps then.

    python experiments/locomotion_speeds.py locomotion [--episodes 256] [--seconds 10]

Each episode has one speed, without turns. The second half of it is measured: the speed
along the path in strides' means against the command, steps a second beside the clips'
own at that speed, whether the feet take turns, and how fast a standing sole slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

import jax
import jax.numpy as jnp
import numpy as np
from commanded import played, steady, straight

from dcc_jax import physics, quat
from dcc_jax.character import BODIES, CONTROL_DT, CONTROL_RATE, asset_path
from dcc_jax.env import features
from dcc_jax.motion import planner
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import RefState, make_references
from dcc_jax.play.recording import Recording
from dcc_jax.tasks.locomotion import Locomotion, LocomotionState

SPEEDS = (0.0, 0.5, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0)
AHEAD, ABREAST = 0.1, 0.05  # m, of a foot before the other one
WINDOW = 1.0  # s, over which the speed is averaged: a stride or more


@dataclass(frozen=True)
class Commanded(Locomotion):
    """One speed for the whole episode, straight ahead."""

    name: ClassVar[str] = "commanded"

    def reset(
        self, key: jax.Array, scene: physics.Scene, reference: RefState
    ) -> tuple[LocomotionState, jax.Array, jax.Array]:
        """As ever, and then it wants one of the speeds."""
        speed_key, key = jax.random.split(key)
        state, qpos, qvel = super().reset(key, scene, reference)
        motion = steady(speed_key, state.motion, SPEEDS)
        return LocomotionState(motion), qpos, qvel


@dataclass(frozen=True)
class Row:
    """What came of one speed."""

    speed: float  # m/s
    episodes: int
    falls: float  # share
    error: float  # m/s, root mean square of the windows' means
    cadence: float  # strides a second
    clips: float  # the same of the clips
    alternating: float  # share of the steps that the other foot takes
    skate: float  # m/s of a standing sole


def rows(recording: Recording, scene: physics.Scene) -> list[Row]:
    """A row a speed."""
    assert recording.motion is not None
    half = recording.alive.shape[0] // 2
    wanted = recording.numbers["task/path_speed"][half:]
    along = recording.numbers["task/speed_along"][half:]
    lead = np.asarray(_lead(jnp.asarray(recording.motion.qpos[half:]), scene))
    slip, stands = (recording.numbers[n][half:] for n in ("slip", "stands"))
    commanded = np.array(SPEEDS)[
        np.argmin(np.abs(wanted[-1][:, None] - np.array(SPEEDS)), axis=1)
    ]
    loops = planner.strides(
        make_references(
            [load_clip(asset_path(f"motions/{n}.npz")) for n in planner.LOOPS]
        )
    )
    found = []
    for speed in SPEEDS:
        mine = commanded == speed
        whole = mine & ~recording.fell & recording.alive.all(axis=0)
        steps = [_steps(lead[:, i]) for i in np.flatnonzero(whole)]
        seconds = lead.shape[0] * CONTROL_DT
        found.append(
            Row(
                speed=speed,
                episodes=int(mine.sum()),
                falls=float(recording.fell[mine].mean()),
                error=_error(along[:, whole], speed),
                cadence=float(np.mean([len(s) / 2.0 / seconds for s in steps])),
                clips=float(loops.cadence(jnp.asarray(speed))) if speed else 0.0,
                alternating=float(np.mean([_alternate(s) for s in steps])),
                skate=float(slip[:, whole].sum() / _stood(stands[:, whole])),
            )
        )
    return found


def _stood(stands: np.ndarray) -> float:
    """Seconds with a sole on the ground, one at least."""
    return max(float(stands.sum()) * CONTROL_DT, 1.0)


def _error(along: np.ndarray, speed: float) -> float:
    size = round(WINDOW * CONTROL_RATE)
    windows = np.lib.stride_tricks.sliding_window_view(along, size, axis=0)
    means = windows.mean(axis=-1)
    return float(np.sqrt(np.mean((means - speed) ** 2)))


@jax.jit
def _way(q: jax.Array) -> jax.Array:
    pos_w, _ = features.body_poses(features.skeleton(), q)
    left, right = (BODIES.index(f"{side}_foot") for side in ("left", "right"))
    _, heading = features.local_frame(q)
    return quat.rotate(quat.inv(heading), pos_w[left] - pos_w[right])[0]


def _lead(qpos: jax.Array, scene: physics.Scene) -> jax.Array:
    """How far the left foot is ahead of the right one [T, N], m."""
    return jax.vmap(jax.vmap(lambda q: _way(scene.character_qpos(q))))(qpos)


def _steps(lead: np.ndarray) -> list[int]:
    """Which foot has come forward, +1 or -1: 10 cm ahead after both were abreast."""
    found: list[int] = []
    abreast = True
    for x in lead:
        if abreast and abs(x) > AHEAD:
            found.append(int(np.sign(x)))
            abreast = False
        elif abs(x) < ABREAST or (found and np.sign(x) != found[-1]):
            abreast = True
    return found


def _alternate(steps: list[int]) -> float:
    turns = np.diff(steps) != 0
    return float(turns.mean()) if len(turns) else 1.0


def main() -> None:
    recording, scene = played(
        __doc__ or "", Locomotion, lambda task: Commanded(gaits=straight(task.gaits))
    )
    print(
        "| commanded, m/s | episodes | falls | rms error, m/s | of the command ", end=""
    )
    print("| strides/s | clips' | feet take turns | skate, cm/s |")
    print("|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for row in rows(recording, scene):
        share = f"{row.error / row.speed:.0%}" if row.speed else "-"
        print(
            f"| {row.speed:g} | {row.episodes} | {row.falls:.0%} | {row.error:.2f} "
            f"| {share} | {row.cadence:.2f} | {row.clips:.2f} "
            f"| {row.alternating:.0%} | {100 * row.skate:.1f} |"
        )


if __name__ == "__main__":
    command.script(main)
