"""Which policy stays on its feet when somebody pulls at its chest for two seconds.

    python experiments/steady_pull.py push sustained-push --newtons 40 70 100

From directions all around, a second into an episode, with the simulation behind the
viewer. Nothing else happens: no balls, no pushes of the task's own. It prints how many
episodes end by a fall within two seconds after the pull.
"""

from __future__ import annotations

import argparse

import numpy as np

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure(devices=1)

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.play.program import Program
from dcc_jax.play.runs import find_run
from dcc_jax.play.simulation import Simulation

BEFORE, PULLED, AFTER = 1.0, 2.0, 2.0  # s


def falls(simulation: Simulation, alpha: float, newtons: float, directions: int) -> int:
    """Of as many episodes as there are directions."""
    count = 0
    for episode in range(directions):
        angle = 2.0 * np.pi * episode / directions
        force_w = newtons * np.array([np.cos(angle), np.sin(angle), 0.0])
        simulation.alpha = alpha
        simulation.reset(episode=episode)
        for step in range(round((BEFORE + PULLED + AFTER) * CONTROL_RATE)):
            if step == round(BEFORE * CONTROL_RATE):
                simulation.push("chest", force_w, PULLED)
            if simulation.step().ended == "fell":
                count += 1
                break
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("policies", nargs="+", metavar="RUN_DIR|NAME")
    add("--newtons", type=float, nargs="+", default=[40.0, 70.0, 100.0])
    add("--alpha", type=float, nargs="+", default=[0.0, 0.5, 0.8])
    add("--directions", type=int, default=12, help="episodes of each cell (12)")
    add("--seed", type=int, default=1)
    options = parser.parse_args()
    heads = [f"{newtons:g} N" for newtons in options.newtons]
    print(f"| falls of {options.directions} | alpha | {' | '.join(heads)} |")
    print("|---|--:|" + "--:|" * len(heads))
    for name in options.policies:
        run = find_run(name)
        simulation = Simulation(run, Program(run), seed=options.seed)
        simulation.events_on = False
        for alpha in options.alpha:
            cells = [
                str(falls(simulation, alpha, newtons, options.directions))
                for newtons in options.newtons
            ]
            print(f"| {name} | {alpha:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    command.script(main)
