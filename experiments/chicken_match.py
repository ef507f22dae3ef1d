"""The chicken fight of Sec. 5.3: a heavy and a light character, each with its policy.

Both were trained against a box (`--task chicken-fight --env.mass 85`, and 36). Here
they hop at each other until one falls. Left who wins, in the middle how far a bump
drives either of them, right the sum of their momenta before and after it: what the
floor does not take is conserved. That the light one is driven farther, in the ratio of
the masses, is Newton's third law; an effect of compliance would be a difference between
the arms. Hollow is the control arm: both policies observe alpha, and nothing is
displaced. Every arm meets the same starts; bars are 95 % intervals. Beside the figure:
FILE.csv, a row a bump, and FILE.json, what is drawn.

    python experiments/chicken_match.py HEAVY_RUN LIGHT_RUN [--alpha 0 0.16] [--video F]

`--mass 85 36` gives the two these masses, whatever they were trained with: masses,
inertias, gains, torque limits and the box all scale with the character's mass, so that
a policy does at any mass what it does at its own (tests/tasks/test_chicken_fight.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import paired

from dcc_jax import command, runtime
from dcc_jax.evaluate import bootstrap
from dcc_jax.evaluate.bootstrap import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dcc_jax.play.runs import Run
    from dcc_jax.tasks.match import Match

DT = 1.0 / 30.0  # s, the control step
PAUSE = 6  # control steps without contact that end a bump
DRIVEN = 15  # control steps after its beginning in which a bump drives
NAMES = ("heavy", "light")


@dataclass(frozen=True)
class Film:
    """N matches of T control steps: what is at the end of each."""

    qpos: np.ndarray  # [T, N, nq]
    qvel: np.ndarray  # [T, N, nv]
    impulse: np.ndarray  # [T, N, 2, 3] N s, on each side
    fallen: np.ndarray  # [T, N, 2] bool


def weighing(run: Run, mass: float) -> Run:
    """The same policy in a character of another mass in kg."""
    env = replace(run.config.env, mass=mass)
    return replace(run, config=replace(run.config, env=env))


def policy_actions(runs: list[Run], alpha: float) -> Callable[[Any], tuple]:
    """The mean actions of both, each of which observes the nearest alpha it knows."""
    from dcc_jax.env.observation import ALPHA_ENTRY

    observed_alpha = [float(np.clip(alpha, *run.alphas)) for run in runs]

    def act(sides):
        return tuple(
            run.policy.mean(side.obs.at[ALPHA_ENTRY].set(known))
            for run, side, known in zip(runs, sides, observed_alpha, strict=True)
        )

    return act


def play(
    match: Match, runs: list[Run], arm: dict, count: int, steps: int, seed
) -> Film:
    """Plays `count` matches with the mean actions."""
    import jax
    import jax.numpy as jnp

    act = policy_actions(runs, arm["alpha"])
    level = jnp.full(2, arm["alpha"] if arm["u_on"] else 0.0)

    def step(sides, keys):
        sides = jax.vmap(lambda key, s: match.step(key, s, act(s)))(keys, sides)
        shot = (
            sides[0].body.qpos,
            sides[0].body.qvel,
            jnp.stack([side.task.impulse for side in sides], axis=1),
            jnp.stack([side.terminated for side in sides], axis=1),
        )
        return sides, shot

    reset_key, step_key = jax.random.split(jax.random.key(seed))
    start = jax.jit(jax.vmap(lambda key: match.reset(key, level)))
    sides = start(jax.random.split(reset_key, count))
    keys = jax.random.split(step_key, (steps, count))
    _, shots = jax.jit(lambda sides, keys: jax.lax.scan(step, sides, keys))(sides, keys)
    return Film(*(np.array(x) for x in shots))


def outcomes(film: Film) -> np.ndarray:
    """0: the heavy one stays up, 1: the light one, 2: neither falls or both at once."""
    steps = len(film.fallen)
    first = np.where(film.fallen.any(axis=0), film.fallen.argmax(axis=0), steps)
    return np.where(
        first[:, 0] == first[:, 1], 2, (first[:, 0] < first[:, 1]).astype(int)
    )


def bumps(film: Film, n: int) -> list[tuple[int, int]]:
    """Control steps [begin, end) of the bumps of a match while both are up."""
    down = film.fallen[:, n].any(axis=-1)
    last = int(down.argmax()) if down.any() else len(film.fallen)
    touching = np.flatnonzero(np.any(film.impulse[:last, n, 0] != 0.0, axis=-1))
    if touching.size == 0:
        return []
    parts = np.split(touching, np.flatnonzero(np.diff(touching) > PAUSE) + 1)
    found = [(int(part[0]), int(part[-1]) + 1) for part in parts]
    return [(a, b) for a, b in found if a > 0 and a + DRIVEN < last]


def row(match: Match, film: Film, n: int, begin: int, end: int) -> dict:
    """One bump: impulse, where it drives both, and momenta along its direction."""
    impulse = film.impulse[begin:end, n, 1].sum(axis=0)
    way = impulse[:2] / np.linalg.norm(impulse[:2])
    before, after = (momenta(match, film, n, t)[:, :2] @ way for t in (begin - 1, end))
    moved = {}
    for i, side in enumerate(match.sides):
        adr = side.scene.qpos_adr
        root = film.qpos[:, n, adr : adr + 2] @ way
        drift = (
            momenta(match, film, n, begin - 1)[i, :2] @ way / side.scene.character.mass
        )
        driven = root[begin - 1 + DRIVEN] - root[begin - 1] - drift * DT * DRIVEN
        moved[f"driven_{NAMES[i]}"] = float(driven)
    return {
        "match": n,
        "second": begin * DT,
        "impulse": float(np.linalg.norm(impulse[:2])),
        **moved,
        "momentum_before": float(before.sum()),
        "momentum_after": float(after.sum()),
    }


def momenta(match: Match, film: Film, n: int, t: int) -> np.ndarray:
    """Of both characters [2, 3] N s, by C MuJoCo."""
    model = match.scene.model
    data = mujoco.MjData(model)
    t = min(t, len(film.qpos) - 1)
    data.qpos[:], data.qvel[:] = film.qpos[t, n], film.qvel[t, n]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    roots = [
        int(model.jnt_bodyid[model.joint(name).id]) for name in ("root", "rival_root")
    ]
    return model.body_subtreemass[roots, None] * data.subtree_linvel[roots]


def measured(arm: dict, results: np.ndarray, rows: list[dict]) -> list[dict]:
    """Everything drawn of an arm, with intervals."""
    found = {
        f"wins_{name}": bootstrap.share(results == i)
        for i, name in enumerate((*NAMES, "nobody"))
    }
    if rows:
        found |= of_bumps(rows, len(results))
    return [{**arm, "name": name, **asdict(x)} for name, x in found.items()]


def of_bumps(rows: list[dict], matches: int) -> dict[str, Interval]:
    """Means over the bumps of so many matches.

    Bumps of a match are alike: whole matches are resampled, and a mean over bumps is
    the ratio of their sums and their numbers.
    """
    draws = bootstrap.draws(matches)
    match = paired.column(rows, "match")

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(match, values, minlength=matches)

    count = total(np.ones(len(rows)))
    before, after = (paired.column(rows, f"momentum_{x}") for x in ("before", "after"))
    sums = {
        "driven_heavy": total(-paired.column(rows, "driven_heavy")),
        "driven_light": total(paired.column(rows, "driven_light")),
        "impulse": total(paired.column(rows, "impulse")),
        "momentum_change": total(after - before),
    }
    return {
        "bumps": bootstrap.mean(count, draws),
        **{name: bootstrap.ratio(x, count, draws) for name, x in sums.items()},
        "driven_light_to_heavy": bootstrap.ratio(
            sums["driven_light"], sums["driven_heavy"], draws
        ),
    }


def draw(points: list[dict], rows: list[dict], out: Path) -> None:
    """Wins, how far bumps drive, momenta."""
    figure, (wins, driven, momentum) = paired.panels([4.5, 4.5, 4.5], height=4.2)
    _draw_bars(wins, points, [f"wins_{name}" for name in (*NAMES, "nobody")])
    wins.set(title="share of matches won", ylim=(0.0, 1.05))
    wins.legend()
    _draw_bars(driven, points, [f"driven_{name}" for name in NAMES])
    driven.set(title=f"driven by a bump in {DRIVEN * DT:g} s (m)")
    driven.set_ylim(bottom=0.0)
    _draw_momenta(momentum, rows)
    figure.savefig(out, dpi=100)


def _draw_bars(axes: Axes, points: list[dict], names: list[str]) -> None:
    levels = [p["alpha"] for p in points]
    for i, arm in enumerate(paired.arms_of(points)):
        own = [p for p in points if arm.items() <= p.items() and p["name"] in names]
        at = [names.index(p["name"]) + 0.12 * i for p in own]
        face = {} if arm["u_on"] else {"markerfacecolor": "white"}
        colour = paired.line(arm, levels)["color"]
        style = {"color": colour, "linestyle": "none", "label": paired.label(arm)}
        paired.errorbar(axes, at, own, **style, **face)
    axes.set_xticks(range(len(names)), [name.split("_")[1] for name in names])


def _draw_momenta(axes: Axes, rows: list[dict]) -> None:
    """Before and after a bump, to the same scale, with what is conserved as a line."""
    levels = [row["alpha"] for row in rows]
    for arm in paired.arms_of(rows):
        before, after = (
            paired.column(rows, f"momentum_{x}", **arm) for x in ("before", "after")
        )
        colour = paired.line(arm, levels)["color"]
        fill = colour if arm["u_on"] else "none"
        axes.plot(before, after, ".", alpha=0.5, color=colour, markerfacecolor=fill)
    axes.axline((0.0, 0.0), slope=1.0, color="0.5", lw=0.8)
    axes.set(xlabel="before", ylabel="after", aspect="equal")
    axes.set_title("momentum of both along a bump (N s)")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("heavy", type=Path, metavar="HEAVY_RUN")
    add("light", type=Path, metavar="LIGHT_RUN")
    paired.add_shared(parser, "chicken_match", (0.0, 0.16))
    add("--matches", type=int, default=64, help="of each arm (64)")
    add("--mass", type=float, nargs=2, metavar="KG", help="of the two (their own)")
    add("--seconds", type=float, default=20.0, help="of a match (20)")
    add("--distance", type=float, default=1.0, help="m between them at first (1.0)")
    add("--video", type=Path, metavar="FILE.mp4", help="the first match, last level")
    return parser.parse_args()


def prepared(options: argparse.Namespace) -> tuple[Match, list[Run]]:
    """The match of the two runs, each with its mass."""
    from dcc_jax.play.runs import find_run, make_environment
    from dcc_jax.tasks.match import Match

    runs = [find_run(path) for path in (options.heavy, options.light)]
    if options.mass is not None:
        runs = [weighing(run, kg) for run, kg in zip(runs, options.mass, strict=True)]
    heavy, light = (make_environment(run) for run in runs)
    return Match(heavy, light, distance=options.distance), runs


def main() -> None:
    options = arguments()
    runtime.ensure()
    from dcc_jax.viz import draw as pictures
    from dcc_jax.viz import files

    match, runs = prepared(options)
    rows, points = [], []
    steps = round(options.seconds / DT)
    for arm in paired.arms(options.alpha, options.control):
        film = play(match, runs, arm, options.matches, steps, options.seed)
        found = [
            arm | row(match, film, n, *bump)
            for n in range(options.matches)
            for bump in bumps(film, n)
        ]
        rows += found
        points += measured(arm, outcomes(film), found)
        if options.video and arm == {"alpha": options.alpha[-1], "u_on": True}:
            images = pictures.frames(
                match.scene.model, film.qpos[:, 0], size=(640, 480)
            )
            files.write_mp4(options.video, images, fps=30)
    paired.write(options.out, rows, points)
    draw(points, rows, options.out)
    paired.tell(points, options.out)


if __name__ == "__main__":
    command.script(main)
