"""A skill's measures over training seeds, beside policies that never knew compliance.

    python experiments/seeds.py door --runs RUN_DIR ... --baselines RUN_DIR ...

Each run meets the same episodes in the arms of `control_table.py`; the baselines, which
were trained at alpha 0, in the first one. A cell is the mean over the trainings and its
95 % interval by Student's t: it covers trainings, as other tables cover episodes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from control_table import SKILLS, Line
from scipy import stats

import dcc_jax
from dcc_jax import command, runtime

if TYPE_CHECKING:
    from dcc_jax.evaluate.report import Report


def means(report: Report, line: Line) -> list[float]:
    """Of the arms, then u alone; NaN where there is nothing."""
    arms = [arm[line.metric].value for arm in report.summary]
    first, on, off = (*arms, *[np.nan] * (3 - len(arms)))
    return [first, on, off, on - off]


def cell(values: Sequence[float], line: Line) -> str:
    """`12.3 [11.0, 13.6]`: mean and interval over the trainings."""
    x = line.scale * np.array(values)
    if not np.isfinite(x).all():
        return "-"
    half = 0.0
    if len(x) > 1:
        half = stats.t.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))
    form = f"{{:.{line.places}f}}"
    mean, low, high = map(form.format, (x.mean(), x.mean() - half, x.mean() + half))
    return f"{mean} [{low}, {high}]" if len(x) > 1 else mean


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("skill", choices=SKILLS)
    add("--runs", type=Path, nargs="+", required=True, metavar="RUN_DIR")
    add("--baselines", type=Path, nargs="*", default=[], metavar="RUN_DIR")
    add("--alpha", type=float, default=0.8, help="above 0 (0.8)")
    add("--episodes", type=int, default=64, help="of each arm and training (64)")
    options = parser.parse_args()
    runtime.ensure()
    skill = SKILLS[options.skill]

    def played(run: Path, levels: tuple[float, ...]) -> Report:
        return dcc_jax.evaluate(
            run, episodes=options.episodes, alpha=levels, seconds=skill.seconds
        )

    reports = [played(run, (0.0, options.alpha)) for run in options.runs]
    without = [played(run, (0.0,)) for run in options.baselines]
    heads = ["alpha 0", f"alpha {options.alpha:g}", "the same, u off", "u alone"]
    heads += [f"trained at alpha 0 ({len(without)})"] * bool(without)
    print(f"| {len(reports)} trainings | {' | '.join(heads)} |")
    print("|---" + "|--:" * len(heads) + "|")
    for line in skill.lines:
        if line.metric not in reports[0].summary[0]:
            continue
        columns = list(zip(*(means(r, line) for r in reports), strict=True))
        columns += [[means(r, line)[0] for r in without]] * bool(without)
        cells = [cell(column, line) for column in columns]
        print(f"| {line.text} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    command.script(main)
