"""What compliance does to the force of a grip that pulls, of a hug that closes, and of
an obstacle that presses.

A spring takes hold of the left hand, or two of the upper arms, and its other end moves
away within half a second. Or one at the chest moves on for a second at 0.5 m/s. The
character stands or walks as its policy has learned to, and nothing else disturbs it.
Three arms meet the same episodes: alpha 0, alpha, and the control arm, in which the
policy observes alpha and nothing is displaced.

    python experiments/soft_contact.py sustained-push
    python experiments/soft_contact.py RUN_DIR --alpha 0.5 0.8 --episodes 384
    python experiments/soft_contact.py sustained-push --press

It prints the largest force of an episode and how the mean over episodes changes, as a
share of the mean at alpha 0: with u, with u off, and by u alone.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import dcc_jax
from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

import flax.struct
import jax
import jax.numpy as jnp
import paired

from dcc_jax import physics, quat
from dcc_jax.character import BODIES, CONTROL_DT
from dcc_jax.env import features
from dcc_jax.motion.paths import Gaits
from dcc_jax.motion.reference import RefState
from dcc_jax.play.pull import Hands, Pulled, no_hands
from dcc_jax.play.runs import find_run

Array = jax.Array

BEGIN, SECONDS = 2.0, 6.0  # s
INWARD = 0.12  # m


@dataclass(frozen=True)
class Spring:
    """Two springs, one at each body; or one, where the other has no stiffness."""

    name: str
    bodies: tuple[str, str]
    stiffness: tuple[float, float]  # N/m
    inward: bool = False  # the ends close sideways; else they go off over the ground
    away: float = 0.4  # m, how far they go off
    closing: float = 0.5  # s, for which the ends move
    damping: float = 0.1  # s, times the stiffness
    lasting: float = SECONDS  # s, after which it lets go


HANDS, ARMS = ("left_hand", "right_hand"), ("left_upper_arm", "right_upper_arm")
SPRINGS = (
    *(Spring(f"pull, {k:g} N/m", HANDS, (k, 0.0)) for k in (5.0, 20.0, 50.0, 100.0)),
    Spring("pull, 250 N/m", HANDS, (250.0, 0.0)),
    Spring("hug, 500 N/m", ARMS, (500.0, 500.0), inward=True),
)
CHEST = ("chest", "right_hand")
OBSTACLES = tuple(
    Spring(
        f"press, {k:g} N/m",
        CHEST,
        (k, 0.0),
        away=0.5,
        closing=1.0,
        damping=0.02,
        lasting=1.0,
    )
    for k in (300.0, 1000.0, 3000.0)
)
"""A slow one that does not stop: 0.5 m/s for a second, then it is gone."""


@flax.struct.dataclass
class HeldState:
    """The task's own state, the hands, and where their springs were fastened."""

    task: Any
    hands: Hands
    time: Array  # [] s since the reset
    spring: Array  # [] int32, index into the springs
    anchor_w: Array  # [2, 3] m, where the bodies were when the springs took hold
    way_w: Array  # [2, 3] m, how far the other ends move


@dataclass(frozen=True)
class Held(Pulled):
    """A task whose character is held by one of some springs, drawn by episode."""

    springs: tuple[Spring, ...] = SPRINGS
    name: ClassVar[str] = "held"

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[Any, Array, Array]:
        """The task's own; nothing is held yet."""
        task_key, which_key, way_key = jax.random.split(key, 3)
        task, qpos, qvel = self.task.reset(task_key, scene, reference)
        spring = jax.random.randint(which_key, (), 0, len(self.springs))
        ids = jnp.array([[scene.body(b) for b in s.bodies] for s in self.springs])
        hands = jax.tree.map(jnp.asarray, no_hands())
        hands = dataclasses.replace(hands, body=ids[spring])
        angle = jax.random.uniform(way_key, minval=-jnp.pi, maxval=jnp.pi)
        away = jnp.array([s.away for s in self.springs])[spring]
        way = away * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
        nowhere = jnp.zeros((2, 3))
        state = HeldState(
            task=task,
            hands=hands,
            time=jnp.zeros(()),
            spring=spring,
            anchor_w=nowhere,
            way_w=way + nowhere,
        )
        return state, qpos, qvel

    def control_step(
        self, key: Array, scene: physics.Scene, state: Any, body: physics.State
    ) -> tuple[Any, physics.State]:
        """The task's own; the springs take hold, and their ends move away."""
        task, body = self.task.control_step(key, scene, state.task, body)
        time, before = state.time + CONTROL_DT, state.time < BEGIN
        here_w, closing_w = self._here(scene, state, body)
        of_springs = [(s.inward, s.closing, s.damping, s.lasting) for s in self.springs]
        inward, closing, damping, lasting = jnp.array(of_springs)[state.spring]
        anchor_w: Array = jax.lax.select(
            jnp.broadcast_to(before, (2, 3)), here_w, state.anchor_w
        )
        way_w: Array = jax.lax.select(
            jnp.broadcast_to(before & (inward > 0), (2, 3)), closing_w, state.way_w
        )
        share = jnp.clip((time - BEGIN) / closing, 0.0, 1.0)
        k = jnp.array([s.stiffness for s in self.springs])[state.spring]
        k = jnp.where((time < BEGIN) | (time > BEGIN + lasting), 0.0, k)
        hands = dataclasses.replace(
            state.hands,
            target_w=anchor_w + share * way_w,
            stiffness=k,
            damping=damping * k,
        )
        return HeldState(task, hands, time, state.spring, anchor_w, way_w), body

    def _here(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> tuple[Array, Array]:
        """Where the bodies are [2, 3], and the way inwards from there [2, 3], m."""
        q = scene.character_qpos(body.qpos)
        pos_w, _ = features.body_poses(features.skeleton(), q)
        rows = [[BODIES.index(name) for name in s.bodies] for s in self.springs]
        _, heading = features.local_frame(q)
        inward = INWARD * jnp.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        return pos_w[jnp.array(rows)[state.spring]], quat.rotate(heading, inward)

    def evaluate(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> dict[str, Array]:
        """The task's own, and which spring holds the character."""
        own = Pulled.evaluate(self, scene, state, body)
        return own | {"spring": state.spring.astype(jnp.float32)}


def lines(rows: list[paired.Row], springs: tuple[Spring, ...]) -> Iterator[str]:
    """Markdown, a row of each spring and level above 0."""
    rigid, *arms = paired.arms_of(rows)
    for i, spring in enumerate(springs):
        here = [row for row in rows if row["task/spring/final"] == i]
        for on in (arm for arm in arms if arm["u_on"]):
            off = on | {"u_on": False}
            peak = paired.mean(here, "force/max", **rigid).value
            cells = [f"{peak:.0f} N"]
            for arm, other in ((on, rigid), (off, rigid), (on, off)):
                change = paired.difference(here, "force/max", arm, other)
                bounds = (change.value, change.low, change.high)
                value, low, high = (f"{x / peak:+.0%}" for x in bounds)
                cells.append(f"{value} [{low}, {high}]")
            for arm in (rigid, off, on):
                cells.append(f"{paired.mean(here, 'fell', **arm).value:.0%}")
            yield f"| {spring.name} | {on['alpha']:g} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_DIR|NAME")
    add("--alpha", type=float, nargs="+", default=[0.5, 0.8], metavar="A")
    add("--episodes", type=int, default=384, help="of each arm, all springs (384)")
    add("--press", action="store_true", help="obstacles press; it is told to stand")
    add("--seed", type=int, default=0)
    options = parser.parse_args()
    springs = OBSTACLES if options.press else SPRINGS
    task = find_run(options.run).config.task.quiet()
    if options.press and not hasattr(task, "gaits"):
        parser.error(f"--press: nobody tells a character of {task.name} where to go")
    if options.press:
        task = dataclasses.replace(task, gaits=Gaits(speeds=(0.0,)))
    report = dcc_jax.evaluate(
        options.run,
        episodes=options.episodes,
        alpha=[0.0, *options.alpha],
        seconds=SECONDS,
        seed=options.seed,
        task=Held(task, springs),
    )
    print(
        "| spring | alpha | peak, alpha 0 | with u | u off | u alone | falls: 0 ",
        end="",
    )
    print("| u off | with u |\n|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    print("\n".join(lines(report.rows, springs)))


if __name__ == "__main__":
    command.script(main)
