"""The runs of a sweep as jobs of their own, wherever an executor starts them.

Each is an ordinary training in its own run directory, which the machines have to share:
it saves, and goes on from where it is when it is started once more.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from dcc_jax.config import Config
from dcc_jax.learn.rollout import Environment
from dcc_jax.training import folder, loop

LOOK_EVERY = 0.2  # s


class Future(Protocol):
    """A job that was started."""

    def done(self) -> bool: ...
    def result(self) -> Any: ...
    def cancel(self) -> Any: ...


class Executor(Protocol):
    """What starts jobs: `concurrent.futures.Executor`, submitit's, or one's own."""

    def submit(self, job: Callable[..., Any], /, *arguments: Any) -> Any: ...


def run(
    executor: Executor,
    runs: Mapping[Path, Config],
    environment: Environment | None,
    say: Callable[[str], None],
) -> bool:
    """Trains every run; the others go on where one fails.

    Args:
        executor: starts them, in this order.
        runs: by their directories, which have been begun.
        environment: in place of the task's own.
        say: hears of every run that ends.

    Returns:
        Whether all have collected their tuples.

    Raises:
        RunError: naming those that failed.
    """
    started: dict[Path, Future] = {
        path: executor.submit(trained, config, path, environment)
        for path, config in runs.items()
    }
    finished: dict[Path, bool] = {}
    failed: dict[Path, str] = {}
    try:
        while len(finished) + len(failed) < len(started):
            time.sleep(LOOK_EVERY)
            for path, future in started.items():
                if path in finished or path in failed or not future.done():
                    continue
                try:
                    finished[path] = bool(future.result())
                    word = "finished" if finished[path] else "stopped"
                except Exception as error:
                    failed[path] = " ".join(f"{error}".split()) or type(error).__name__
                    word = f"failed ({failed[path]}):"
                ended = len(finished) + len(failed)
                say(f"{ended} of {len(started)}: {word} {path}")
    finally:
        for future in started.values():
            future.cancel()
    if failed:
        named = ", ".join(f"{path.name} ({why})" for path, why in failed.items())
        raise folder.RunError(f"{len(failed)} of {len(started)} runs failed: {named}")
    return all(finished.values())


def trained(config: Config, run_dir: Path, environment: Environment | None) -> bool:
    """Trains one run from where it is; whether it has collected all tuples."""
    result = loop.train(
        config, run_dir=run_dir, resume=True, environment=environment, quiet=True
    )
    return result.finished
