"""Trains the toy in a process of its own: `toy_run.py RUN_DIR [--resume] [UPDATES]`."""

from __future__ import annotations

import sys

INTERVAL = 10


def toy_config(updates: int):
    """The toy under the real configuration's roof."""
    import dataclasses

    from dcc_jax.config import Config
    from toy import ToyConfig, ToyTask

    small = ToyConfig()
    return Config(
        task=ToyTask(),
        ppo=small.ppo,
        disc=small.disc,
        train=dataclasses.replace(
            small.train,
            total_tuples=updates * small.train.tuples_per_update,
            checkpoint_interval=INTERVAL,
        ),
    )


def main(arguments: list[str]) -> int:
    from dcc_jax.training import loop
    from toy import Toy

    resume = "--resume" in arguments
    run_dir, updates = (a for a in arguments if a != "--resume")
    result = loop.train(
        toy_config(int(updates)), run_dir=run_dir, resume=resume, environment=Toy()
    )
    print("finished" if result.finished else "stopped")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
