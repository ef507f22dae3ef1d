"""The table of docs/results.md that compares levels of compliance, for one skill.

The arms meet the same episodes: alpha 0, each alpha, and its control arm, in which the
policy observes alpha and nothing is displaced. The last columns are paired differences
of the means, u on less u off: the effect of compliance alone.

    python experiments/control_table.py trampoline            # plays, then prints
    python experiments/control_table.py FILE.json --skill trampoline

FILE.json is what `python -m dcc_jax.evaluate RUN --json FILE.json` has written.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import dcc_jax
from dcc_jax import command, runtime


@dataclass(frozen=True)
class Line:
    """A metric of the table: its name there, the unit's factor, decimal places."""

    metric: str
    text: str
    scale: float = 1.0
    places: int = 1


@dataclass(frozen=True)
class Skill:
    """What is asked of a skill: seconds of an episode, metrics, a door's width."""

    seconds: float
    lines: tuple[Line, ...]
    width: float | None = None  # m


FELL = Line("fell", "episodes that end by a fall (%)", 100.0)
TORQUE = Line("torque/rms", "RMS torque (N m)", 1.0, 2)
IN_CONTACT = (
    Line("contact/peak", "peak force of a contact (N)"),
    Line("contact/impulse", "impulse of a contact (N s)", 1.0, 2),
    Line("contact/torque", "RMS torque during contact (N m)", 1.0, 2),
)
U = (
    Line("u/joints_max", "largest u, all joints together (mrad)", 1e3),
    Line("u/root_max", "largest u of the root (mm)", 1e3),
)
PATH = Line("task/path_distance/mean", "distance to the path, mean (mm)", 1e3)
DOOR = (
    Line("task/orthogonal_force/mean", "force orthogonal to the knob's path (N)", 1, 2),
    Line("task/parallel_force/mean", "force along it (N)", 1, 2),
    Line("task/angle/final", "angle in the end (mrad)", 1e3),
    Line("task/open/final", "doors open in the end (%)", 100.0),
    TORQUE,
    *U,
)
SKILLS = {
    "push": Skill(10.0, (FELL, *IN_CONTACT, TORQUE, *U)),
    "trampoline": Skill(
        12.0,
        (
            FELL,
            Line("contact/foot_low", "lowest sole during contact (mm)", 1e3),
            Line("contact/pelvis_low", "lowest pelvis during contact (mm)", 1e3),
            Line("contact/energy", "energy gained in a contact (J)"),
            Line("energy", "energy at all times (J)"),
            *IN_CONTACT,
            Line("style/nearest", "distance to the clips (mm)", 1e3),
            *U,
        ),
    ),
    "backflip": Skill(
        6.0,
        (
            FELL,
            Line("task/flips/final", "backflips landed and stood (%)", 100.0),
            Line("contact/foot_low", "lowest sole during contact (mm)", 1e3),
            Line("contact/pelvis_low", "lowest pelvis during contact (mm)", 1e3),
            *IN_CONTACT,
            *U,
        ),
    ),
    "hand-in-hand": Skill(
        10.0,
        (
            FELL,
            Line("force/mean", "force of the hand, mean (N)"),
            Line("force/max", "largest force of an episode (N)"),
            PATH,
            TORQUE,
            *U,
        ),
    ),
    "chicken-fight": Skill(10.0, (FELL, *IN_CONTACT, PATH, TORQUE, *U)),
    "sustained-push": Skill(10.0, (FELL, PATH, TORQUE, *U)),
    "ball": Skill(
        10.0,
        (
            FELL,
            Line("task/offset/mean", "offset of the ball, mean (mm)", 1e3, 2),
            Line("task/lean/mean", "lean of the pole, mean (mrad)", 1e3, 2),
            TORQUE,
            *U,
        ),
    ),
    "door": Skill(5.0, DOOR),
    "door-1.5": Skill(5.0, DOOR, width=1.5),
}


def played(name: str, options: argparse.Namespace) -> dict:
    """The report of a skill's policy, as its json has it."""
    from dcc_jax.tasks.door import Door

    skill, run = SKILLS[name], options.run or name.partition("-1.5")[0]
    task = None if skill.width is None else Door(width=skill.width)
    report = dcc_jax.evaluate(
        run,
        episodes=options.episodes,
        alpha=(0.0, *options.alpha),
        seconds=skill.seconds,
        task=task,
    )
    return json.loads(report.to_json())


def table(report: dict, lines: tuple[Line, ...]) -> str:
    """Markdown: a row a metric, the arms, then what u alone does at each alpha."""
    conditions = report["conditions"]
    alone = [c for c in report["comparisons"] if not conditions[c["baseline"]]["u_on"]]
    heads = [_name(c) for c in conditions]
    heads += [f"u alone, {conditions[c['condition']]['alpha']:g}" for c in alone]
    head = f"| | {' | '.join(heads)} |\n|---|{'--:|' * len(heads)}"
    rows = [
        _row(report, alone, line) for line in lines if line.metric in report["rows"][0]
    ]
    return "\n".join([head, *rows])


def _row(report: dict, alone: list[dict], line: Line) -> str:
    cells = [_text(s[line.metric], line) for s in report["summary"]]
    cells += [_text(c["difference"][line.metric], line, sign="+") for c in alone]
    return f"| {line.text} | {' | '.join(cells)} |"


def _name(condition: dict) -> str:
    told = f"alpha {condition['alpha']:g}"
    return told if condition["u_on"] else f"{told}, u off"


def _text(interval: dict, line: Line, sign: str = "") -> str:
    """`12.3 [11.0, 13.6]` in the unit of the line; `-` where there is nothing."""
    numbers = [interval[k] for k in ("value", "low", "high")]
    if numbers[0] is None:
        return "-"
    form = f"{{:{sign}.{line.places}f}}"
    value, low, high = (form.format(line.scale * (x or 0.0)) for x in numbers)
    return f"{value} [{low}, {high}]"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("source", metavar="SKILL|FILE.json", help=", ".join(SKILLS))
    add("--skill", choices=SKILLS, help="whose table FILE.json makes")
    add("--run", type=Path, metavar="RUN_DIR", help="its policy (the one that ships)")
    add("--episodes", type=int, default=64, help="of each arm (64)")
    add("--alpha", type=float, nargs="+", default=[0.5, 0.8], help="levels above 0")
    options = parser.parse_args()
    name = options.skill or options.source
    if name not in SKILLS:
        parser.error(f"skill must be one of {', '.join(SKILLS)}, got {name}")
    if options.skill:
        report = json.loads(Path(options.source).read_text())
    else:
        runtime.ensure()
        report = played(name, options)
    print(table(report, SKILLS[name].lines))


if __name__ == "__main__":
    command.script(main)
