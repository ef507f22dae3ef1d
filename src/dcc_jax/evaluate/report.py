"""The evaluation: conditions played, measured, summed up and compared in pairs.

Letters: N episodes, K contacts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.env.task import Task
from dcc_jax.evaluate import bootstrap, compare, measures
from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.compare import Comparison, Condition, Part
from dcc_jax.learn import style
from dcc_jax.play.player import Player
from dcc_jax.play.recording import Recording
from dcc_jax.play.runs import Run, find_run, make_environment


@dataclass(frozen=True)
class Report:
    """What an evaluation found."""

    task: str
    parameters: dict[str, dict[str, Any]]  # of the task as it was played, by run
    imitation: dict[str, str]  # adversarial or tracking, by run
    seed: int
    seconds: float
    conditions: list[Condition]
    summary: list[dict[str, Interval]]  # of each condition, by metric
    comparisons: list[Comparison]
    rows: list[dict[str, Any]]  # one an episode: run, alpha, u_on, episode, metrics
    contacts: list[dict[str, Any]]  # one a contact: likewise, start, peak, ...
    clock: str | None  # what the curves are drawn over; None: time since the reset
    curves: list[dict[str, list[list[float]]]]  # of each condition: s, mean, half width
    survival: list[list[float]]  # of each condition: share standing after each step

    def to_json(self) -> str:
        """Everything as json; numbers that are undefined become null."""
        return json.dumps(_defined(asdict(self)), indent=1, default=str) + "\n"


def evaluate(
    run_dir: str | Path | Sequence[str | Path],
    *,
    episodes: int = 256,
    alpha: float | Sequence[float] | None = None,
    seed: int = 0,
    seconds: float | None = None,
    task: Mapping[str, Any] | Task | None = None,
    control: bool = True,
    say: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Plays episodes of the mean action and measures them.

    Episodes are paired: the same initial states and perturbations for every level of
    compliance and every run.

    Args:
        run_dir: a run directory, a policy that ships, or several of them.
        episodes: of each condition.
        alpha: levels of compliance, or one; None: the least and the greatest of the
            training.
        seed: of everything that is drawn.
        seconds: length of an episode; None: as in training.
        task: other parameters of the run's task, `{"width": 1.5}`, or another task.
        control: where levels are compared, play each level above 0 once more with u
            off: the policy observes alpha, and nothing is displaced.
        say: told what a reader of the numbers has to know.
        progress: told control steps done and to be done.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
    """
    plan = prepare(run_dir, episodes, alpha, seed, seconds, task, say, control)
    return execute(plan, progress)


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation that is about to begin: its input is checked."""

    conditions: list[tuple[Run, Condition]]
    players: dict[str, Player]  # by run
    episodes: int
    seed: int
    seconds: float


def prepare(
    run_dir: str | Path | Sequence[str | Path],
    episodes: int,
    alpha: float | Sequence[float] | None,
    seed: int,
    seconds: float | None,
    task: Mapping[str, Any] | Task | None,
    say: Callable[[str], None],
    control: bool = True,
) -> EvaluationPlan:
    """Checks everything a user can get wrong; arguments as of `evaluate`."""
    names = [run_dir] if isinstance(run_dir, str | Path) else list(run_dir)
    runs = [find_run(name) for name in names]
    if isinstance(alpha, float | int):
        alpha = [alpha]
    _check(runs, episodes, alpha, seed, seconds)
    return EvaluationPlan(
        conditions=_conditions([(r, _levels(r, alpha, say)) for r in runs], control),
        players=_players(runs, task),
        episodes=episodes,
        seed=seed,
        seconds=runs[0].config.env.episode_seconds if seconds is None else seconds,
    )


def execute(plan: EvaluationPlan, progress: Callable[[int, int], None]) -> Report:
    """Plays and measures."""
    steps = round(plan.seconds * CONTROL_RATE) * plan.episodes
    total = steps * len(plan.conditions)
    parts: list[Part] = []
    clips: dict[Player, style.Reference] = {}
    for i, (run, condition) in enumerate(plan.conditions):
        player = plan.players[run.name]
        recording = player.play(
            run,
            range(plan.episodes),
            [condition.level] * plan.episodes,
            observed_alpha=[condition.alpha] * plan.episodes,
            seed=plan.seed,
            seconds=plan.seconds,
            progress=lambda done, i=i: progress(i * steps + done, total),
        )
        if player not in clips:
            clips[player] = _clips(player)
        parts.append(_part(player, clips[player], recording, condition))
    return _report(parts, plan)


def _check(
    runs: list[Run],
    count: int,
    alpha: Sequence[float] | None,
    seed: int,
    seconds: float | None,
) -> None:
    if not runs:
        raise ValueError("run_dir is empty; give at least one run")
    if count < 1:
        raise ValueError(f"episodes must be 1 or more, got {count}")
    for level in alpha if alpha is not None else ():
        for run in runs:
            run.config.env.compliance.check_alpha(level)
    if alpha is not None and len(set(alpha)) < max(1, len(alpha)):
        raise ValueError(f"alpha must be different numbers, got {list(alpha)}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed must be between 0 and 2^32 - 1, got {seed}")
    if seconds is not None and not 0.1 <= seconds <= 3600.0:
        raise ValueError(f"seconds must be in [0.1, 3600], got {seconds}")
    if len({run.name for run in runs}) < len(runs):
        raise ValueError(f"a run is given twice: {', '.join(r.name for r in runs)}")
    tasks = sorted({run.config.task.name for run in runs})
    if len(tasks) > 1:
        raise ValueError(f"the runs must be of one task, got {', '.join(tasks)}")


def _levels(
    run: Run, alpha: Sequence[float] | None, say: Callable[[str], None]
) -> list[float]:
    low, high = run.alphas
    if alpha is None:
        return sorted({low, high})
    strange = [f"{x:g}" for x in alpha if not low - 1e-6 <= x <= high + 1e-6]
    if strange:
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        say(
            f"{run.name} was trained at alpha {trained}: at {', '.join(strange)} its "
            "policy observes the nearest alpha that it knows"
        )
    return [float(level) for level in alpha]


def _conditions(
    levels: list[tuple[Run, list[float]]], control: bool
) -> list[tuple[Run, Condition]]:
    """Every level of every run, then its control arms."""
    control = control and len({x for _, xs in levels for x in xs}) > 1
    found = []
    for run, own in levels:
        found += [(run, Condition(run.name, x)) for x in own]
        if control:
            found += [(run, Condition(run.name, x, u_on=False)) for x in own if x > 0.0]
    return found


def _players(
    runs: list[Run], task: Mapping[str, Any] | Task | None
) -> dict[str, Player]:
    """By run. Runs whose environments differ in alpha alone share a program."""
    shared: dict[str, Player] = {}
    players = {}
    for run in runs:
        environment = make_environment(run, task)
        env = asdict(run.config.env) | {"alpha": None, "alpha_max": None}
        same = repr((environment.task, env))
        players[run.name] = shared.setdefault(same, Player(environment))
    return players


def _clips(player: Player) -> style.Reference:
    return jax.jit(lambda: style.make_reference(player.environment))()


def _part(
    player: Player, clips: style.Reference, recording: Recording, condition: Condition
) -> Part:
    clock = player.environment.task.clock
    nearest = np.full(recording.pairs_alive.shape, np.nan)
    alive = recording.pairs_alive
    pairs = jnp.asarray(recording.pairs[alive])
    frechet = np.nan
    if len(pairs):
        nearest[alive] = style.nearest(clips, pairs)
        frechet = float(style.frechet(clips, pairs, jnp.ones(len(pairs))))
    contacts = [measures.contacts_of(recording, n) for n in range(len(recording.fell))]
    return Part(
        condition=condition,
        rows=measures.rows(recording, nearest, contacts, clock),
        contacts=contacts,
        pooled={"style/frechet": frechet, "broken": float(recording.nan.sum())},
        curves=measures.curves(recording, clock),
        survival=measures.survival(recording),
    )


def _report(parts: list[Part], plan: EvaluationPlan) -> Report:
    task = plan.players[parts[0].condition.run].environment.task
    resamples = bootstrap.draws(plan.episodes)
    return Report(
        task=task.name,
        parameters={
            name: asdict(player.environment.task)
            for name, player in plan.players.items()
        },
        imitation={name: p.environment.imitation for name, p in plan.players.items()},
        seed=plan.seed,
        seconds=plan.seconds,
        conditions=[part.condition for part in parts],
        summary=[compare.summary(part, resamples) for part in parts],
        comparisons=compare.comparisons(parts, resamples),
        rows=[
            _named(part, n) | row for part in parts for n, row in enumerate(part.rows)
        ],
        contacts=[
            _named(part, n) | contact
            for part in parts
            for n, of_episode in enumerate(part.contacts)
            for contact in of_episode
        ],
        clock=task.clock,
        curves=[part.curves for part in parts],
        survival=[part.survival for part in parts],
    )


def _named(part: Part, episode: int) -> dict[str, Any]:
    return {**asdict(part.condition), "episode": episode}


def _defined(value: Any) -> Any:
    """The same tree with null in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {k: _defined(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_defined(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
