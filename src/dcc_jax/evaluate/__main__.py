"""`python -m dcc_jax.evaluate RUN_DIR...`: the numbers of trained policies."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dcc_jax import command

if TYPE_CHECKING:
    from dcc_jax.evaluate.report import EvaluationPlan

PROGRAM = "dcc_jax.evaluate"
_DESCRIPTION = """Plays episodes of a trained policy's mean action and measures them.
Every level of compliance meets the same initial states and perturbations. Where levels
are compared, a control arm tells the policy alpha and displaces nothing. Exit status:
0 done; 2 a bad argument; 1 a failure."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    return command.run(_parser(), argv, _plan, _run)


def _parser() -> command.Parser:
    parser = command.Parser(prog=f"python -m {PROGRAM}", description=_DESCRIPTION)
    add = parser.add_argument
    add(
        "run_dir",
        nargs="+",
        metavar="RUN_DIR",
        help="a run directory, or the name of a policy that ships",
    )
    add("--episodes", type=int, default=256, metavar="N", help="a level (256)")
    add(
        "--alpha",
        type=float,
        nargs="+",
        metavar="A",
        help="levels of compliance, the first is the baseline (those of the training)",
    )
    add(
        "--control",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="play each level above 0 also with u off (yes)",
    )
    add("--seconds", type=float, metavar="S", help="of an episode (as in training)")
    add("--seed", type=int, default=0, metavar="N", help="of all that is drawn (0)")
    add("--json", type=Path, metavar="FILE", help="everything, raw rows included")
    add("--figure", type=Path, metavar="FILE.png", help="a page of figures")
    return parser


def _plan(options: argparse.Namespace) -> EvaluationPlan:
    from dcc_jax.evaluate import report, show

    if options.figure is not None:
        show.check_format(options.figure)
    for path in (options.json, options.figure):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
    return report.prepare(
        options.run_dir,
        options.episodes,
        options.alpha,
        options.seed,
        options.seconds,
        None,
        lambda text: print(text, file=sys.stderr),
        options.control,
    )


def _run(plan: EvaluationPlan, options: argparse.Namespace) -> None:
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
