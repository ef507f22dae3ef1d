"""The chicken fight of Sec. 5.3: a heavy and a light character, each with its policy.

Both were trained against a box (`--task chicken-fight --env.mass 85`, and 36). Here
they hop at each other until one falls. Left who wins, in the middle how far a bump
drives either of them, right the sum of their momenta before and after it: what the
floor does not take is conserved. Every level of compliance meets the same starts; bars
are 95 % intervals. Beside the figure: FILE.csv, a row a bump, and FILE.json, what is
drawn.

    python experiments/chicken_match.py HEAVY_RUN LIGHT_RUN [--alpha 0 0.16] [--video F]

With `--mass 85 36` the two have these masses, whatever they were trained with: masses,
inertias, gains, torque limits and the box all scale with the character's mass, so that
a policy does at any mass what it does at its own (tests/tasks/test_chicken_fight.py).
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import paired

from dcc_jax import runtime
from dcc_jax.evaluate import bootstrap

if TYPE_CHECKING:
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


def play(match: Match, runs: list[Run], level: float, count: int, steps: int, seed):
    """Plays `count` matches with the mean actions."""
    import jax
    import jax.numpy as jnp

    from dcc_jax.env.observation import ALPHA_ENTRY

    observed_alpha = [float(np.clip(level, *run.alphas)) for run in runs]

    def act(sides):
        return tuple(
            run.policy.mean(side.obs.at[ALPHA_ENTRY].set(alpha))
            for run, side, alpha in zip(runs, sides, observed_alpha, strict=True)
        )

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
    start = jax.jit(jax.vmap(lambda key: match.reset(key, jnp.full(2, level))))
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
    last = int(down.argmax()) if down.any() else len(down)
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
        drift = momenta(match, film, n, begin - 1)[i, :2] @ way / mass(match, i)
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


def mass(match: Match, i: int) -> float:
    return match.sides[i].scene.character.mass


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


def measured(level: float, results: np.ndarray, rows: list[dict]) -> list[dict]:
    """Everything drawn at a level of compliance, with intervals."""
    named = [
        (f"wins_{name}", bootstrap.share(results == i))
        for i, name in enumerate((*NAMES, "nobody"))
    ]
    if rows:
        # Bumps of a match are alike: whole matches are resampled, and a mean over
        # bumps is the ratio of their sums and their numbers.
        draws = bootstrap.draws(len(results))
        value = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        lost = value["momentum_after"] - value["momentum_before"]

        def total(values: np.ndarray) -> np.ndarray:
            return np.bincount(value["match"], values, minlength=len(results))

        count, impulse = total(np.ones(len(rows))), total(value["impulse"])
        heavy, light = total(-value["driven_heavy"]), total(value["driven_light"])
        named += [
            ("bumps", bootstrap.mean(count, draws)),
            ("driven_heavy", bootstrap.ratio(heavy, count, draws)),
            ("driven_light", bootstrap.ratio(light, count, draws)),
            ("driven_light_to_heavy", bootstrap.ratio(light, heavy, draws)),
            ("impulse", bootstrap.ratio(impulse, count, draws)),
            ("momentum_change", bootstrap.ratio(total(lost), count, draws)),
        ]
    return [{"alpha": level, "name": name, **asdict(x)} for name, x in named]


def draw(points: list[dict], rows: list[dict], out: Path) -> None:
    """Wins, how far bumps drive, momenta."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (wins, driven, momentum) = plt.subplots(1, 3, figsize=(13.5, 4))
    for i, level in enumerate(dict.fromkeys(p["alpha"] for p in points)):
        here = {p["name"]: p for p in points if p["alpha"] == level}
        for place, names in (
            (wins, ("wins_heavy", "wins_light", "wins_nobody")),
            (driven, ("driven_heavy", "driven_light")),
        ):
            found = [here[name] for name in names if name in here]
            if not found:
                continue
            value = [p["value"] for p in found]
            bars = (
                [p["value"] - p["low"] for p in found],
                [p["high"] - p["value"] for p in found],
            )
            at = np.arange(len(found)) + 0.12 * i
            place.errorbar(
                at, value, bars, fmt="o", capsize=3, label=f"alpha {level:g}"
            )
            place.set_xticks(np.arange(len(found)), [n.split("_")[1] for n in names])
        own = [row for row in rows if row["alpha"] == level]
        momentum.plot(
            [row["momentum_before"] for row in own],
            [row["momentum_after"] for row in own],
            ".",
            alpha=0.5,
        )
    ends = np.array([*momentum.get_xlim(), *momentum.get_ylim()])
    momentum.plot([ends.min(), ends.max()], [ends.min(), ends.max()], "0.5", lw=0.8)
    wins.set(title="share of matches won", ylim=(0.0, 1.05))
    driven.set(title=f"driven by a bump in {DRIVEN * DT:g} s (m)")
    momentum.set(
        title="momentum of both along a bump (N s)", xlabel="before", ylabel="after"
    )
    wins.legend()
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("heavy", type=Path, metavar="HEAVY_RUN")
    add("light", type=Path, metavar="LIGHT_RUN")
    add("--alpha", type=float, nargs="+", default=[0.0, 0.16], metavar="A")
    add("--matches", type=int, default=64, help="of each level (64)")
    add("--mass", type=float, nargs=2, metavar="KG", help="of the two (their own)")
    add("--seconds", type=float, default=20.0, help="of a match (20)")
    add("--distance", type=float, default=1.0, help="m between them at first (1.0)")
    add("--seed", type=int, default=0)
    add("--out", type=Path, default=Path("runs/chicken_match.png"), metavar="FILE.png")
    add("--video", type=Path, metavar="FILE.mp4", help="the first match, last level")
    options = parser.parse_args()
    runtime.ensure()
    from dcc_jax.play.runs import find_run, make_environment
    from dcc_jax.tasks.match import Match
    from dcc_jax.viz import draw as pictures

    runs = [find_run(path) for path in (options.heavy, options.light)]
    if options.mass is not None:
        runs = [weighing(run, kg) for run, kg in zip(runs, options.mass, strict=True)]
    heavy, light = (make_environment(run) for run in runs)
    match = Match(heavy, light, distance=options.distance)
    rows, points, film = [], [], None
    steps = round(options.seconds / DT)
    for level in options.alpha:
        film = play(match, runs, level, options.matches, steps, options.seed)
        found = [
            row(match, film, n, *bump)
            for n in range(options.matches)
            for bump in bumps(film, n)
        ]
        rows += [{"alpha": level, **r} for r in found]
        points += measured(level, outcomes(film), found)
    paired.write(options.out, rows, points)
    draw(points, rows, options.out)
    for p in points:
        interval = f"{p['value']:.3f} [{p['low']:.3f}, {p['high']:.3f}]"
        print(f"alpha {p['alpha']:.2f}  {p['name']:22s} {interval}")
    if options.video is not None and film is not None:
        images = pictures.frames(match.scene.model, film.qpos[:, 0], size=(640, 480))
        pictures.write_mp4(options.video, images, fps=30)
    print(options.out)


if __name__ == "__main__":
    main()
