"""`dcc-jax evaluate RUN_DIR...`: the numbers of trained policies."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from dcc_jax import command
from dcc_jax.play import overrides

if TYPE_CHECKING:
    from dcc_jax.evaluate.drag import DragPlan
    from dcc_jax.evaluate.report import EvaluationPlan

PROGRAM = "dcc_jax.evaluate"


@dataclass(frozen=True)
class Options:
    """Plays episodes of a trained policy's mean action and measures them.

    Every level of compliance meets the same initial states and perturbations. Where
    levels are compared, a control arm tells the policy alpha and displaces nothing.

    Exit status: 0 done; 2 a bad argument; 1 a failure."""

    run_dir: Annotated[
        Positional[tuple[str, ...]],
        arg(metavar="RUN_DIR [RUN_DIR ...]", help_behavior_hint="(required)"),
    ]
    """Run directories, or names of policies that ship."""

    episodes: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: 256; with --drag 2)")
    ] = None
    """Episodes of each level of compliance."""

    alpha: Annotated[
        tuple[float, ...] | None,
        arg(metavar="A [A ...]", help_behavior_hint="(default: as in training)"),
    ] = None
    """Levels of compliance; the first is the baseline."""

    control: bool = True
    """Play each level above 0 also with u off."""

    drag: bool = False
    """Drag at hands, chest and head instead: the stiffness they have beside Eq. (7)."""

    seconds: Annotated[
        float | None, arg(metavar="S", help_behavior_hint="(default: as in training)")
    ] = None
    """Length of an episode."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Of everything that is drawn."""

    task: overrides.TaskParameters = ()

    json: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")
    ] = None
    """Writes everything, raw rows included."""

    figure: Annotated[
        Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")
    ] = None
    """Writes a page of figures."""

    def __post_init__(self) -> None:
        if not self.run_dir:
            raise ValueError("missing: RUN_DIR")
        if self.alpha == ():
            raise ValueError("--alpha needs a value")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(PROGRAM, argv, partial(overrides.read, PROGRAM, Options), _plan)


def _plan(options: Options) -> command.Work:
    command.start_jax()
    from dcc_jax.evaluate import report, show

    if options.figure is not None:
        show.check_format(options.figure)
    for path in (options.json, options.figure):
        if path is not None:
            if path.is_dir():
                raise ValueError(f"{path} is a directory, not a file to write")
            path.parent.mkdir(parents=True, exist_ok=True)
    if options.drag:
        return _plan_drag(options)
    plan = report.prepare(
        options.run_dir,
        256 if options.episodes is None else options.episodes,
        options.alpha,
        options.seed,
        options.seconds,
        overrides.changes(PROGRAM, options.run_dir[0], options.task),
        lambda text: print(text, file=sys.stderr),
        options.control,
    )
    return partial(_measure, plan, options)


def _plan_drag(options: Options) -> command.Work:
    from dcc_jax.evaluate import drag
    from dcc_jax.play.runs import find_run

    if len(options.run_dir) != 1:
        raise ValueError(f"--drag takes one RUN_DIR, got {len(options.run_dir)}")
    if options.seconds is not None:
        raise ValueError("--seconds does nothing with --drag")
    if not options.control:
        raise ValueError("--no-control does nothing with --drag")
    run = find_run(options.run_dir[0])
    plan = drag.prepare(
        run,
        options.alpha,
        2 if options.episodes is None else options.episodes,
        options.seed,
        overrides.changes(PROGRAM, options.run_dir[0], options.task),
    )
    return partial(_drag, plan, options)


def _drag(plan: DragPlan, options: Options) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from dcc_jax.evaluate import drag, show_drag

    with Progress(console=Console(stderr=True), transient=True) as bar:
        line = bar.add_task("compiling and dragging", total=None)
        found = drag.execute(
            plan, lambda done, total: bar.update(line, completed=done, total=total)
        )
    Console(width=None if sys.stdout.isatty() else 400).print(
        show_drag.table(plan.run.name, found)
    )
    if options.json is not None:
        options.json.write_text(show_drag.to_json(plan.run.name, found))
        print(f"wrote {options.json}")
    if options.figure is not None:
        show_drag.figure(plan.run.name, found, options.figure)
        print(f"wrote {options.figure}")


def _measure(plan: EvaluationPlan, options: Options) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from dcc_jax.evaluate import report, show

    with Progress(console=Console(stderr=True), transient=True) as bar:
        line = bar.add_task("compiling and playing", total=None)
        found = report.execute(
            plan, lambda done, total: bar.update(line, completed=done, total=total)
        )
    # In a file the table is as wide as it likes.
    Console(width=None if sys.stdout.isatty() else 400).print(show.table(found))
    if options.json is not None:
        options.json.write_text(found.to_json())
        print(f"wrote {options.json}")
    if options.figure is not None:
        show.figure(found, options.figure)
        print(f"wrote {options.figure}")


if __name__ == "__main__":
    command.leave(main())
