"""The push that half of the characters survive, by its direction, as a polar map.

A force pushes the chest for a tenth of a second; direction and impulse are drawn by
episode. Who stands 3 s later has survived. A logistic curve over the impulse, fitted in
each of eight sectors, says where half of them fall. Arms as in `soft_contact.py`.

    python experiments/survivable_impulse.py sustained-push --alpha 0 0.5
"""

from __future__ import annotations

import argparse
import dataclasses
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
import numpy as np
import paired
from scipy.optimize import minimize

from dcc_jax import physics, quat
from dcc_jax.character import CONTROL_DT
from dcc_jax.env import features
from dcc_jax.evaluate import bootstrap
from dcc_jax.motion.reference import RefState
from dcc_jax.play.pull import PUSH, Hands, Pulled, no_hands
from dcc_jax.play.runs import find_run

Array = jax.Array

BEGIN, LASTING, SECONDS = 2.0, 0.1, 5.0  # s
IMPULSE = (0.1, 2.5)  # N s per kg of the character
SECTORS = 8
RESAMPLES = 200


@flax.struct.dataclass
class StruckState:
    """The task's own state, and the push."""

    task: Any
    hands: Hands
    time: Array  # [] s since the reset
    angle: Array  # [] rad, 0: to the front, pi / 2: to the left
    impulse: Array  # [] N s / kg


@dataclass(frozen=True)
class Struck(Pulled):
    """A task whose character is pushed once at the chest."""

    mass: float = 65.0
    """Of the character, kg."""
    name: ClassVar[str] = "struck"

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[Any, Array, Array]:
        """The task's own; the push comes later."""
        task_key, angle_key, impulse_key = jax.random.split(key, 3)
        task, qpos, qvel = self.task.reset(task_key, scene, reference)
        chest = scene.body("chest")
        hands = jax.tree.map(jnp.asarray, no_hands())
        hands = dataclasses.replace(
            hands,
            body=hands.body.at[PUSH].set(chest),
            point=hands.point.at[PUSH].set(jnp.asarray(scene.model.body_ipos[chest])),
        )
        angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
        low, high = IMPULSE
        impulse = jax.random.uniform(impulse_key, minval=low, maxval=high)
        return StruckState(task, hands, jnp.zeros(()), angle, impulse), qpos, qvel

    def control_step(
        self, key: Array, scene: physics.Scene, state: Any, body: physics.State
    ) -> tuple[Any, physics.State]:
        """The task's own, and the push while it lasts."""
        task, body = self.task.control_step(key, scene, state.task, body)
        _, heading = features.local_frame(scene.character_qpos(body.qpos))
        over = jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), jnp.zeros(())])
        force_w = self.mass * state.impulse / LASTING * quat.rotate(heading, over)
        since = state.time - BEGIN
        acts = (since > -1e-4) & (since < LASTING - 1e-4)
        hands = dataclasses.replace(
            state.hands,
            force_w=state.hands.force_w.at[PUSH].set(jnp.where(acts, force_w, 0.0)),
        )
        time = state.time + CONTROL_DT
        return dataclasses.replace(state, task=task, hands=hands, time=time), body

    def evaluate(
        self, scene: physics.Scene, state: Any, body: physics.State
    ) -> dict[str, Array]:
        """The task's own, and the push: its angle (rad), its impulse (N s / kg)."""
        own = Pulled.evaluate(self, scene, state, body)
        return own | {"angle": state.angle, "impulse": state.impulse}


def survivable(impulse: np.ndarray, fell: np.ndarray) -> float:
    """The impulse at which half fall, by a logistic curve over its logarithm."""
    x = np.log(impulse)

    def surprise(w: np.ndarray) -> float:
        z = np.exp(w[1]) * (x - w[0])
        return float(
            np.sum(np.logaddexp(0.0, np.where(fell, -z, z))) + 0.01 * w[1] ** 2
        )

    return float(np.exp(minimize(surprise, [0.0, 1.0], method="Nelder-Mead").x[0]))


def by_sector(rows: list[paired.Row], arm: paired.Arm) -> list[paired.Row]:
    """A point each sector: the survivable impulse with its interval."""
    angle = paired.column(rows, "task/angle/max", **arm)
    impulse = paired.column(rows, "task/impulse/max", **arm)
    fell = paired.column(rows, "fell", **arm).astype(bool)
    width = 2.0 * np.pi / SECTORS
    sector = np.round(angle / width).astype(int) % SECTORS
    points = []
    for i in range(SECTORS):
        at = np.flatnonzero(sector == i)
        draws = at[bootstrap.draws(len(at))[:RESAMPLES]]
        found = [survivable(impulse[d], fell[d]) for d in draws]
        low, high = np.percentile(found, [2.5, 97.5])
        value = survivable(impulse[at], fell[at])
        name = f"{360 * i // SECTORS} degrees"
        points.append({**arm, "name": name, "value": value, "low": low, "high": high})
    return points


def draw(points: list[paired.Row], out: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(5.5, 5.5), layout="constrained")
    axes = figure.add_subplot(projection="polar", theta_offset=np.pi / 2)
    arms = paired.arms_of(points)
    levels = [arm["alpha"] for arm in arms]
    for arm in arms:
        own = [p for p in points if {k: p[k] for k in arm} == arm]
        angle = np.arange(SECTORS + 1) * 2.0 * np.pi / SECTORS
        style = paired.line(arm, levels)
        closed = [p["value"] for p in [*own, own[0]]]
        axes.plot(angle, closed, label=paired.label(arm), **style)
        low, high = ([p[k] for p in [*own, own[0]]] for k in ("low", "high"))
        axes.fill_between(angle, low, high, color=style["color"], alpha=0.15)
    axes.set_title("survivable impulse at the chest (N s / kg), front is up")
    axes.legend(loc="lower left", fontsize=8)
    figure.savefig(out, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_DIR|NAME")
    add("--episodes", type=int, default=512, help="of each arm (512)")
    paired.add_shared(parser, "survivable_impulse", (0.0, 0.5))
    options = parser.parse_args()
    config = find_run(options.run).config
    report = dcc_jax.evaluate(
        options.run,
        episodes=options.episodes,
        alpha=options.alpha,
        seconds=SECONDS,
        seed=options.seed,
        task=Struck(config.task.quiet(), mass=config.env.mass),
        control=options.control,
    )
    arms = paired.arms_of(report.rows)
    points = [p for arm in arms for p in by_sector(report.rows, arm)]
    paired.write(options.out, report.rows, points)
    draw(points, options.out)
    paired.tell(points, options.out)


if __name__ == "__main__":
    command.script(main)
