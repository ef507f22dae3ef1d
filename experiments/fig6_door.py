"""Fig. 6: the forces at the knob against the width of the door, by level of compliance.

Left what of the force is orthogonal to the knob's path, in the middle what is along it,
right how many doors are open in the end. The policies know a door of 1.0 m alone.
Dashed is the control arm: the policy observes alpha, and nothing is displaced. Every
door and every arm meet the same episodes; bars are 95 % intervals over them. Beside the
figure: FILE.csv, a row an episode, and FILE.json, what is drawn.

    python experiments/fig6_door.py [RUN_DIR...] [--alpha 0 0.16] [--out FILE.png]

Several runs, trained with different seeds, are pooled. Without one a policy is trained
first, into `runs/fig6_door`.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, astuple
from pathlib import Path
from typing import TYPE_CHECKING

import paired

from dcc_jax import command, runtime

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVELS = (0.0, 0.16)
OPEN = "task/open/final"
ORTHOGONAL = "task/orthogonal_force/mean"
PANELS = {
    ORTHOGONAL: "force orthogonal to the knob's path (N)",
    "task/parallel_force/mean": "force along the knob's path (N)",
    OPEN: "doors open in the end",
}


def measure(options: argparse.Namespace) -> list[dict]:
    """A row an episode: width, run, arm, episode and what was measured."""
    from dcc_jax.tasks.door import Door

    runs, rows = paired.policies(options, "door"), []
    for width in options.widths:
        report = paired.evaluated(options, runs, Door(width=width))
        rows += [{"width": width, **row} for row in report.rows]
        print(f"width {width:.2f} m: {len(report.rows)} episodes")
    return rows


def measured(rows: list[dict]) -> list[dict]:
    """Mean and interval of every number by width and arm.

    `ratio` is that of the means to the first level's, episodes paired.
    """
    first, *_ = arms = paired.arms_of(rows)
    return [
        {"width": width, **arm, "name": name}
        | asdict(paired.mean(rows, name, **arm, width=width))
        | {"ratio": astuple(paired.ratio(rows, name, arm, first, width=width))}
        for width in dict.fromkeys(row["width"] for row in rows)
        for name in PANELS
        for arm in arms
    ]


def draw(points: list[dict], out: Path) -> None:
    """The three panels."""
    figure, axes = paired.panels([4.2] * len(PANELS))
    for place, (name, title) in zip(axes, PANELS.items(), strict=True):
        _draw_lines(place, [p for p in points if p["name"] == name])
        place.set(xlabel="width of the door (m)", title=title)
        place.grid(alpha=0.3)
    axes[-1].set_ylim(0.0, 1.05)
    axes[0].legend()
    figure.savefig(out, dpi=120)


def _draw_lines(axes: Axes, points: list[dict]) -> None:
    """Over the width, a line an arm; zero is on the axis."""
    levels = [p["alpha"] for p in points]
    for arm in paired.arms_of(points):
        own = [p for p in points if arm.items() <= p.items()]
        style = paired.line(arm, levels) | {"label": paired.label(arm)}
        paired.errorbar(axes, [p["width"] for p in own], own, **style)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


def main() -> None:
    parser = paired.parser(__doc__ or "", "fig6_door", LEVELS)
    widths = [round(1.0 + 0.1 * i, 1) for i in range(8)]
    parser.add_argument("--widths", type=float, nargs="+", default=widths)
    options = parser.parse_args()
    runtime.ensure()
    rows = measure(options)
    points = measured(rows)
    effects = [
        p for w in options.widths for p in paired.effects(rows, ORTHOGONAL, width=w)
    ]
    paired.write(options.out, rows, points + effects)
    draw(points, options.out)
    for width in options.widths:
        print(f"width {width:g} m")
        paired.tell_effects([p for p in effects if p["width"] == width])
    print(options.out)


if __name__ == "__main__":
    command.script(main)
