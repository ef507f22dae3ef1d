"""`dcc-jax train`: trains a policy; `--help` lists every option.

The loop itself is in `dcc_jax.training.loop`. This file imports nothing heavy before
jax has been told how many devices there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from dcc_jax import command
from dcc_jax.training import curves

if TYPE_CHECKING:
    from dcc_jax.options import Options
    from dcc_jax.training.loop import Run

PROGRAM = "dcc_jax.train"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(PROGRAM, argv, _read, _prepare)


def _read(arguments: list[str]) -> Options:
    command.start_jax()
    from dcc_jax import options

    return options.parse(arguments)


def _prepare(said: Options) -> command.Work:
    from dcc_jax.training import loop

    return partial(_train, loop.prepare(said.config, said.run_dir, said.resume))


def _train(run: Run) -> None:
    from dcc_jax.training import loop, processes

    try:
        result = loop.execute(run)
        if result.metrics and processes.is_first():
            curves.draw([result.run_dir], result.run_dir / "curves.png")
    except loop.RunError as error:
        raise command.WorkError(str(error)) from None
    except KeyboardInterrupt:
        raise command.WorkError(
            "interrupted twice; what was not saved is lost"
        ) from None
    except Exception as error:
        raise command.unforeseen(error, run.run_dir / "error.log") from None


if __name__ == "__main__":
    command.leave(main())
