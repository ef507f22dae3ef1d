"""What helps the discriminator to teach: short trainings, one lever at a time.

    python experiments/adversarial_bench.py push --tuples 1200000 --seeds 3
    python experiments/adversarial_bench.py locomotion --levers default paper

Each row is the mean of a lever's trainings, at alpha 0, and the mean action's motion
after it: r_q, how many the discriminator judges right (clips and policy in equal
shares) and by what margin, falls, and the distances to the clips. Trainings that are
there already in `--out` are not repeated.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from statistics import fmean
from typing import Any

import dcc_jax
from dcc_jax import command
from dcc_jax.training import logs

OPEN = {"disc.gradient_penalty": 10.0, "disc.instance_noise": 0.0}
LEVERS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {**OPEN, "disc.feature_floor": 0.01, "ppo.sigma_degrees": 6.0},
    "penalty 10": {"disc.gradient_penalty": 10.0},
    "penalty 200": {"disc.gradient_penalty": 200.0},
    "no instance noise": {"disc.instance_noise": 0.0},
    "instance noise 0.6": {"disc.instance_noise": 0.6},
    "floor 0.01": {"disc.feature_floor": 0.01},
    "penalty 10, no instance noise": OPEN,
    "exploration 6 degrees": {"ppo.sigma_degrees": 6.0},
    "KL divergence 0.01": {"ppo.target_kl": 0.01},
    "the last update's policy": {"train.averaged_updates": 1},
    "pairs 3 steps apart": {"disc.span": 3},
    "pairs 10 steps apart": {"disc.span": 10},
    "velocities count three times": {"env.velocity_time": 0.1},
    "turns as 1 m, floor 0.1": {"env.turn_arm": 1.0, "disc.feature_floor": 0.1},
    "turns as 0.1 m, floor 0.1": {"env.turn_arm": 0.1, "disc.feature_floor": 0.1},
    "turns as 0.1 m, penalty 10": {"env.turn_arm": 0.1, "disc.gradient_penalty": 10.0},
    "turns as 0.1 m, noise 0.1": {"env.turn_arm": 0.1, "disc.instance_noise": 0.1},
    "turns as 0.1 m, floor 0.03": {"env.turn_arm": 0.1, "disc.feature_floor": 0.03},
    "turns as 0.1 m, floor 0.01": {"env.turn_arm": 0.1, "disc.feature_floor": 0.01},
    "4 minibatches": {"disc.minibatches": 4},
    "learning rate 3e-5": {"disc.learning_rate": 3e-5},
    "beta 0.25": {"env.reward.beta": 0.25},
    "no warm start": {"train.warm_start_steps": 0},
}
COLUMNS = {
    "reward/r_q": ("r_q", "{:.2f}"),
    "right": ("D right", "{:.0%}"),
    "disc/margin": ("margin", "{:.2f}"),
    "disc/gradient_penalty": ("slope^2", "{:.3f}"),
    "fell": ("falls", "{:.0%}"),
    "style/nearest": ("nearest, mm", "{:.1f}"),
    "style/frechet": ("Frechet, mm", "{:.0f}"),
}
"""Of a row: its heading and how it is written."""
LAST = 20  # updates, of whose metrics the mean is taken


def trained(task: str, lever: str, seed: int, tuples: int, out: Path) -> dict[str, Any]:
    """What a training came to; read where it is there already."""
    name = re.sub(r"\W+", "-", lever)
    folder = out / f"{task}-{name}-{tuples}-{seed}"
    table = folder / "bench.json"
    config = dcc_jax.make_config(task, preset="cpu").with_(
        {
            "seed": seed,
            "env.alpha": 0.0,
            "train.total_tuples": tuples,
            **LEVERS[lever],
        }
    )
    if table.exists():
        # Not sooner: jax has to find the settings that `dcc_jax.train` makes for it.
        from dcc_jax.config import load

        if load(folder) != config:
            raise SystemExit(f"{folder} was trained otherwise; --out names another")
        return json.loads(table.read_text())
    resume = folder.exists()
    if not dcc_jax.train(config, run_dir=folder, resume=resume, quiet=True).finished:
        raise SystemExit(f"stopped in {folder}; the same command goes on")
    rows = logs.read(folder)[-LAST:]
    names = ("reward/r_q", "disc/margin", "disc/gradient_penalty")
    found = {name: fmean(row[name] for row in rows) for name in names}
    both = ("disc/accuracy_real", "disc/accuracy_fake")
    found["right"] = fmean(row[name] for row in rows for name in both)
    report = dcc_jax.evaluate(folder, episodes=64, alpha=0.0)
    for name in ("fell", "style/nearest", "style/frechet"):
        found[name] = report.summary[0][name].value
    for name in ("style/nearest", "style/frechet"):
        found[name] *= 1e3
    table.write_text(json.dumps(found, indent=1) + "\n")
    return found


def line(lever: str, runs: list[dict[str, Any]]) -> str:
    """A row: mean, and least and greatest where there are several seeds."""
    cells = []
    for name, (_, form) in COLUMNS.items():
        values = [run[name] for run in runs]
        cell = form.format(fmean(values))
        if len(runs) > 1:
            cell += f" ({form.format(min(values))} to {form.format(max(values))})"
        cells.append(cell)
    return f"| {lever} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("task", nargs="?", default="push")
    add("--tuples", type=int, default=1_200_000)
    add("--seeds", type=int, default=1, help="0, 1, ... (1)")
    add("--levers", nargs="+", choices=LEVERS, default=list(LEVERS), metavar="LEVER")
    add("--out", type=Path, default=Path("runs/bench"), help="(runs/bench)")
    options = parser.parse_args()
    print(f"| {options.task} | {' | '.join(head for head, _ in COLUMNS.values())} |")
    print("|---" + "|--:" * len(COLUMNS) + "|", flush=True)
    for lever in options.levers:
        runs = [
            trained(options.task, lever, seed, options.tuples, options.out)
            for seed in range(options.seeds)
        ]
        print(line(lever, runs), flush=True)


if __name__ == "__main__":
    command.script(main)
