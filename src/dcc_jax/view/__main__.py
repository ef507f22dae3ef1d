"""`dcc-jax view [RUN_DIR]`: a trained policy live in a browser, to pull at."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from dcc_jax import command
from dcc_jax.play import overrides

PROGRAM = "dcc_jax.view"
FIRST = "sustained-push"
"""The policy that is shown where none is named: it has learned to bear a pull."""
MISSING = "the viewer needs {}: pip install 'dcc-jax[view]'"


@dataclass(frozen=True)
class Options:
    """Shows a trained policy live in a browser: drag a body to pull it, move alpha.

    Ctrl-C ends it. Exit status: 0 done; 2 a bad argument; 1 a failure."""

    run_dir: Annotated[
        Positional[str | None],
        arg(metavar="[RUN_DIR]", help_behavior_hint=f"(default: {FIRST})"),
    ] = None
    """A run directory, or the name of a policy that ships."""

    alpha: Annotated[
        float | None,
        arg(
            metavar="A",
            help_behavior_hint="(default: that of the training, at most 0.5)",
        ),
    ] = None
    """Level of compliance at first."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Of everything that is drawn."""

    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Where the page is served. Anything but loopback lets others in: 0.0.0.0 everyone
    who can reach this machine."""

    port: Annotated[int, arg(metavar="N")] = 8080
    """Of the page; the next free one where it is taken."""

    out: Annotated[Path, arg(metavar="DIR")] = Path("saved")
    """Where films and clips are saved."""

    task: overrides.TaskParameters = ()

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed must be in [0, 2^32 - 1], got {self.seed}")
        if not 1 <= self.port <= 65535:
            raise ValueError(f"--port must be in [1, 65535], got {self.port}")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(PROGRAM, argv, partial(overrides.read, PROGRAM, Options), _plan)


def _plan(options: Options) -> command.Work:
    try:
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(MISSING.format(error.name)) from None
    from dcc_jax.view import server

    port = server.free_port(options.host, options.port)
    command.start_jax()
    from dcc_jax.play import runs

    known = runs.known_runs()
    name = options.run_dir or (FIRST if FIRST in known else known[0])
    run = runs.find_run(name)
    if options.alpha is not None:
        run.config.env.compliance.check_alpha(options.alpha, "--alpha")
    task = overrides.changes(PROGRAM, name, options.task)
    return partial(_serve, options, run.name, known, port, task)


def _serve(
    options: Options, name: str, known: list[str], port: int, task: dict[str, Any]
) -> None:
    from dcc_jax import runtime
    from dcc_jax.view import server
    from dcc_jax.view.viewer import Viewer

    page = server.start(options.host, port)
    print(f"open {server.address(options.host, page.get_port())}   (Ctrl-C ends it)")
    warning = server.who_can_reach(options.host, page.get_port())
    if warning:
        print(warning)
    sys.stdout.flush()
    # One character: a second device would only wait.
    runtime.ensure(devices=1, quiet=True)
    viewer = Viewer(
        page,
        name,
        tuple(known),
        seed=options.seed,
        alpha=options.alpha,
        task=task,
        out=options.out,
    )
    loop = threading.Thread(target=viewer.run, name="simulation", daemon=True)
    loop.start()
    try:
        while loop.is_alive():
            loop.join(0.5)
    except KeyboardInterrupt:
        print("closed")
    finally:
        viewer.close()
        loop.join(2.0)


if __name__ == "__main__":
    command.leave(main())
