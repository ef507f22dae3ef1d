"""The stiffness that a moving character has at its hands, chest and head.

A force ramps up at a body and holds, while the trained policy balances and
walks. The yield is how far the body's centre of mass moves relative to the pelvis, in
the pelvis's frame, against the same episode without the force. It is compared with what
Eq. (7) has at the poses of that episode, see `rest`.
Letters: K trials, T control steps, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.character import CONTROL_RATE, Character
from dcc_jax.env.environment import Environment
from dcc_jax.evaluate import bootstrap, rest
from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.dragging import BODIES, STEPS, Dragging, Trials
from dcc_jax.play.pull import Pulled
from dcc_jax.play.runs import Run, find_run, make_environment

LEVELS = (0.0, 0.16, 0.3, 0.5, 0.7, 0.8)
AVERAGED = 1.0  # s, the last of the hold: a stride of a walk
NEAR = 0.25
"""A trial whose stiffness is within this share of theory's delivers it (as the field
counts it)."""
SEEN = 0.01
"""m, the yield of a trial that is seen: of those below, balance moves a body by as
much."""


@dataclass(frozen=True)
class Drag:
    """Of one level of compliance, every trial with a force."""

    alpha: float
    body: np.ndarray  # [K] index into BODIES
    episode: np.ndarray  # [K]
    newtons: np.ndarray  # [K]
    measured: np.ndarray  # [K] N/m, force over the yield along it; NaN where it fell
    theory: np.ndarray  # [K] N/m, the force over the yield along it by Eq. (7)
    fell: np.ndarray  # [K] bool, in it or in the same episode without a force

    def at(self, body: str, least: float = 0.0) -> np.ndarray:
        """The trials at a body that ended upright, indices, and for which theory has a
        yield of at least so many m."""
        far = self.newtons >= least * self.theory
        return np.flatnonzero((self.body == BODIES.index(body)) & ~self.fell & far)

    def share_near(self, body: str, least: float = 0.0) -> Interval:
        """Of the trials at a body, as of `at`, those within `NEAR` of theory."""
        at = self.at(body, least)
        near = np.abs(self.measured[at] / self.theory[at] - 1.0) < NEAR
        return bootstrap.share_of(near, self.episode[at], self._resamples())

    def stiffness(self, body: str) -> Interval:
        """Median of the measured stiffness at a body, N/m.

        It is one over the median yield of a newton: a body that balance moves against
        the force is stiffer than all others, not softer.
        """
        at = self.at(body)
        found = bootstrap.quantile(
            1.0 / self.measured[at], self.episode[at], 0.5, self._resamples()
        )
        return Interval(*(1.0 / x for x in (found.value, found.high, found.low)))

    def expected(self, body: str) -> float:
        """Median of the theoretical stiffness over the same trials, N/m."""
        at = self.at(body)
        return float(np.median(self.theory[at])) if len(at) else np.nan

    def _resamples(self) -> np.ndarray:
        """Of whole episodes: the trials of one share its motion."""
        return bootstrap.draws(int(self.episode.max()) + 1)


@dataclass(frozen=True)
class DragPlan:
    """A drag that is about to begin: its input is checked."""

    run: Run
    environment: Environment
    alpha: Sequence[float]
    trials: Trials
    seed: int


def drag(
    run_dir: str | Path,
    alpha: Sequence[float] | None = None,
    episodes: int = 2,
    seed: int = 0,
    task: Mapping[str, Any] | None = None,
) -> list[Drag]:
    """Drags a run's character about at each level of compliance.

    Args:
        run_dir: a run directory, or a policy that ships; a task's own disturbances at
            random are off.
        alpha: levels of compliance; None: those of `LEVELS` that it was trained with.
        episodes: of each trial, with other initial states and motions.
        seed: of everything that is drawn.
        task: other parameters of the run's task, `{"gaits.speeds": (0.0,)}`.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
    """
    return execute(prepare(find_run(run_dir), alpha, episodes, seed, task))


def prepare(
    run: Run,
    alpha: Sequence[float] | None,
    episodes: int,
    seed: int,
    task: Mapping[str, Any] | None,
) -> DragPlan:
    """Checks everything a user can get wrong; arguments as of `drag`."""
    if episodes < 1:
        raise ValueError(f"episodes must be 1 or more, got {episodes}")
    law = run.config.env.compliance.law
    if law != "admittance":
        raise ValueError(
            f"a drag's theory is that of 'admittance', and the law is {law!r}"
        )
    low, high = run.alphas
    known = [x for x in LEVELS if low <= x <= high] or sorted({low, high})
    levels = known if alpha is None else list(alpha)
    if not levels:
        raise ValueError("alpha must hold a level of compliance")
    for level in levels:
        run.config.env.compliance.check_alpha(level)
    changes = {f"task.{name}": value for name, value in (task or {}).items()}
    changed = run.config.with_(changes)
    environment = make_environment(run, Pulled(changed.task.quiet()))
    if environment.follows_reference:
        _check_length(environment)
    return DragPlan(run, environment, levels, Trials.of(episodes), seed)


def execute(
    plan: DragPlan, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Drag]:
    """Drags and measures; `progress` is told levels done and to be done."""
    play, found = Dragging(plan.environment), []
    for level in plan.alpha:
        progress(len(found), len(plan.alpha))
        found.append(_measured(plan, level, play))
    return found


def slope(drags: Sequence[Drag], body: str) -> float:
    """Of log measured over log theoretical median stiffness at a body, over alpha.

    Of the trials that ended upright at every level: those that fall when it is soft
    are the soft ones.
    """
    upright = ~np.any([drag.fell for drag in drags], axis=0)
    at = np.flatnonzero((drags[0].body == BODIES.index(body)) & upright)
    if len(drags) < 2 or not len(at):
        return np.nan
    found = -np.log([np.median(1.0 / drag.measured[at]) for drag in drags])
    expected = np.log([np.median(drag.theory[at]) for drag in drags])
    return float(np.polyfit(expected, found, 1)[0])


def _check_length(environment: Environment) -> None:
    references, steps = environment.references, STEPS / CONTROL_RATE
    ends = ~references.loop & (references.duration < steps)
    if bool(ends.any()):
        name = references.names[int(ends.argmax())]
        raise ValueError(
            f"a drag lasts {steps:g} s, and the clip {name} that "
            f"{environment.task.name} follows ends before"
        )


def _measured(plan: DragPlan, alpha: float, play: Dragging) -> Drag:
    character, trials = plan.environment.scene.character, plan.trials
    q, ended = play(plan.run, trials, alpha, plan.seed)  # [T, K, 55], [K]
    q = q[-round(AVERAGED * CONTROL_RATE) :]
    pulled = trials.body >= 0
    body, force, episode = trials.body[pulled], trials.force[pulled], trials.episode
    alone = episode[pulled]  # where the same episode without a force is
    newtons = np.linalg.norm(force, axis=1)
    seen, turn = _from_pelvis(character, q)
    each = np.arange(len(body))
    away = seen[:, pulled][:, each, body] - seen[:, alone][:, each, body]
    along = np.einsum("tkji,kj->tki", turn[:, pulled], force)  # N, in its frame
    yields = np.sum(away * along, axis=-1).mean(axis=0) / newtons
    expected = _expected(character, q[:, alone], along, body, alpha)
    fell = ended[pulled] | ended[alone]
    with np.errstate(divide="ignore"):
        found = np.where(fell, np.nan, newtons / yields)
    return Drag(alpha, body, alone, newtons, found, newtons / expected, fell)


def _from_pelvis(character: Character, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of mass [T, K, bodies, 3] in the pelvis's frame, m, and its rotation
    [T, K, 3, 3], at coordinates [T, K, 55]."""
    bodies = rest.Bodies(character, BODIES)
    turn = Rotation.from_quat(q[..., 3:7].reshape(-1, 4), scalar_first=True)
    points = np.asarray(jax.jit(jax.vmap(jax.vmap(bodies.centers)))(q))
    return points, turn.as_matrix().reshape(*q.shape[:2], 3, 3)


def _expected(
    character: Character,
    q: np.ndarray,
    force: np.ndarray,
    body: np.ndarray,
    alpha: float,
) -> np.ndarray:
    """Yields along the force [K], m, that theory has: the mean over poses q [T, K, 55]
    under forces [T, K, 3] in the pelvis's frame. Every fifth: six of the second."""
    q, force = q[::5], force[::5]
    times = len(q)
    moved = rest.yields_at_rest(
        character,
        BODIES,
        alpha,
        q.reshape(-1, q.shape[-1]),
        force.reshape(-1, 3),
        np.tile(body, times),
    ).reshape(force.shape)
    newtons = np.linalg.norm(force, axis=-1)
    return (np.sum(moved * force, axis=-1) / newtons).mean(axis=0)
