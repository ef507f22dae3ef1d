"""`dcc-jax COMMAND`, and `python -m dcc_jax COMMAND`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from dcc_jax import command

PROGRAM = "dcc_jax"
COMMANDS = {
    "train": ("dcc_jax.train", "train a compliant policy"),
    "evaluate": ("dcc_jax.evaluate.__main__", "measure trained policies"),
    "render": ("dcc_jax.render.__main__", "make a video of a trained policy"),
    "view": ("dcc_jax.view.__main__", "pull a trained policy in a browser"),
    "motion": ("dcc_jax.motion.__main__", "import motion files, look at clips"),
    "curves": ("dcc_jax.training.curves", "draw how training went"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit status."""
    return command.choose(PROGRAM, COMMANDS, argv)


def script() -> NoReturn:
    """What `dcc-jax` runs."""
    command.leave(main())


if __name__ == "__main__":
    script()
