"""Our own clips, by name: what a fresh install trains on.

`author(name)` plans the motion at 60 Hz and keeps every second frame: 30 fps, the
control rate. The same code gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dcc_jax.motion.clip import Clip
from tools.author_clips import door, gaits, hop, jumps, run, stand
from tools.author_clips.dynamics import Solved
from tools.author_clips.jumps import Jump
from tools.author_clips.style import FPS, RATE

SOURCE = "tools/author_clips"
LICENCE = "Apache-2.0"
DECIMALS = 5  # of qpos, so that the last bits of a linear solver do not show


@dataclass(frozen=True)
class Recipe:
    """How one clip is made."""

    make: Callable[[], Solved]
    label: str
    loop: bool = False
    phase: bool = False  # whether the clip carries its share of the duration


def _recoveries() -> dict[str, Recipe]:
    return {
        f"recover_{angle:03d}": Recipe(
            lambda angle=angle: stand.recovery(np.radians(angle)), "recover"
        )
        for angle in range(0, 360, 45)
    }


def _turning(name: str, make: Callable[..., Solved], turn: float) -> dict[str, Recipe]:
    """A gait straight ahead, to the left and to the right by `turn` rad a step."""
    turns = {name: 0.0, f"{name}_left": turn, f"{name}_right": -turn}
    return {
        key: Recipe(partial(make, turn=angle), name) for key, angle in turns.items()
    }


RECIPES: dict[str, Recipe] = {
    "stand": Recipe(stand.stand, "stand", loop=True),
    **_recoveries(),
    "balance": Recipe(stand.small_steps, "balance"),
    "jump": Recipe(lambda: jumps.jumps([Jump(0.20)]), "jump"),
    "jump_high": Recipe(lambda: jumps.jumps([Jump(0.32)]), "jump"),
    "jump_series": Recipe(
        lambda: jumps.jumps(
            [
                Jump(0.14),
                Jump(0.18, x=0.12),
                Jump(0.22, x=-0.12),
                Jump(0.18, y=0.10),
                Jump(0.14, y=-0.10),
                Jump(0.20, yaw=0.5),
            ]
        ),
        "jump",
    ),
    "backflip": Recipe(jumps.backflip, "backflip"),
    **_turning("walk", gaits.walk, 0.20),
    "walk_slow_cycle": Recipe(lambda: gaits.walk_cycle(gaits.SLOW), "walk", loop=True),
    "walk_cycle": Recipe(gaits.walk_cycle, "walk", loop=True),
    "walk_fast_cycle": Recipe(lambda: gaits.walk_cycle(gaits.FAST), "walk", loop=True),
    **_turning("jog", partial(run.run, run.JOG), 0.18),
    "jog_cycle": Recipe(lambda: run.run_cycle(run.JOG), "jog", loop=True),
    **_turning("run", run.run, 0.15),
    "run_cycle": Recipe(run.run_cycle, "run", loop=True),
    "hop": Recipe(hop.hop, "hop"),
    "hop_cycle": Recipe(partial(hop.hop_cycle, 0.0, 0.0), "hop", loop=True),
    "hop_ahead_cycle": Recipe(
        partial(hop.hop_cycle, hop.LENGTH, 0.0), "hop", loop=True
    ),
    "hop_left_cycle": Recipe(partial(hop.hop_cycle, 0.0, hop.LENGTH), "hop", loop=True),
    "door": Recipe(door.open_door, "door", phase=True),
}
"""Every clip of ours; the recovery directions are degrees, 0 ahead, 90 left."""


def clip_names() -> tuple[str, ...]:
    """Names `author` knows."""
    return tuple(RECIPES)


def author(name: str) -> Clip:
    """Makes one clip.

    Raises:
        ValueError: a name that is not in `clip_names()`.
    """
    if name not in RECIPES:
        raise ValueError(f"no clip {name!r}; there are {', '.join(RECIPES)}")
    recipe = RECIPES[name]
    return as_clip(recipe.make(), name, recipe)


def as_clip(solved: Solved, name: str, recipe: Recipe) -> Clip:
    """The planned motion at 30 fps."""
    qpos = solved.pose.qpos()[:: RATE // FPS]
    if recipe.loop:
        qpos = _closed(qpos)
    phase = np.linspace(0.0, 1.0, len(qpos), dtype=np.float32)
    return Clip(
        qpos=(np.round(qpos, DECIMALS) + 0.0).astype(np.float32),  # and no -0.0
        fps=float(FPS),
        name=name,
        source=SOURCE,
        licence=LICENCE,
        loop=recipe.loop,
        label=recipe.label,
        phase=phase if recipe.phase else None,
    )


def _closed(qpos: np.ndarray) -> np.ndarray:
    """The same from the origin, the last frame equal to the first, joints and height.

    Periodic plans agree there to the accuracy of the solution already.
    """
    qpos = qpos.copy()
    qpos[:, :2] -= qpos[0, :2]
    qpos[-1, 2], qpos[-1, 7:] = qpos[0, 2], qpos[0, 7:]
    return qpos
