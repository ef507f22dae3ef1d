"""What an update of every task costs beside one of `push`.

    python benchmarks/scenes.py [TASK...] [--preset cpu] [--rounds 5]

Whole updates, rollout and learning, of all tasks take turns in one run; seconds are
medians. Policies are untrained, so that most of them fall and begin anew.
"""

from __future__ import annotations

import argparse

from training import medians, update_of

from dcc_jax import command, tasks
from dcc_jax.config import make_config


def main() -> None:
    """Parses the arguments, measures, prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tasks", nargs="*", default=tasks.TASKS, metavar="TASK")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    names = ["push", *(name for name in args.tasks if name != "push")]
    configs = {name: make_config(name, args.preset) for name in names}
    seconds = medians(
        {
            n: update_of(tasks.make_environment(c.task, c.env), c)
            for n, c in configs.items()
        },
        args.rounds,
    )
    print(f"{'task':15s}{'tuples/s':>10s}{'push = 1':>10s}")
    for name, taken in seconds.items():
        rate = configs[name].train.tuples_per_update / taken
        print(f"{name:15s}{rate:10.0f}{taken / seconds['push']:10.2f}")


if __name__ == "__main__":
    command.script(main)
