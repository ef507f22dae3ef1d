"""The stiffness that a moving character has at its hands, chest and head.

A force ramps up at a body, holds and lets go, while the trained policy balances and
walks. The yield is how far the body's centre of mass moves relative to the pelvis, in
the pelvis's frame, against the same episode without the force. It is compared with the
stiffness that Eq. (7) gives at the poses of that episode.
Letters: K trials, T control steps, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax import quat
from dcc_jax.character import CONTROL_RATE, Character, compose_scene
from dcc_jax.control.stiffness import softened_gains, stiffness
from dcc_jax.env import features
from dcc_jax.env.environment import Environment
from dcc_jax.evaluate import bootstrap
from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.evaluate.dragging import BODIES, Dragging, Trials
from dcc_jax.play.pull import Pulled
from dcc_jax.play.runs import Run, find_run, make_environment

Array = jax.Array

LEVELS = (0.0, 0.16, 0.3, 0.5, 0.7, 0.8)
AVERAGED = 1.0  # s, the last of the hold: a stride of a walk
NEAR = 0.25
"""A trial whose stiffness is within this share of theory's delivers it (as the field
counts it)."""


@dataclass(frozen=True)
class Drag:
    """Of one level of compliance, every trial with a force."""

    alpha: float
    body: np.ndarray  # [K] index into BODIES
    episode: np.ndarray  # [K]
    newtons: np.ndarray  # [K]
    measured: np.ndarray  # [K] N/m, force over the yield along it; NaN where it fell
    theory: np.ndarray  # [K] N/m, by Eq. (7) and the weights
    fell: np.ndarray  # [K] bool, in it or in the same episode without a force

    def at(self, body: str) -> np.ndarray:
        """The trials at a body that ended upright, indices."""
        return np.flatnonzero((self.body == BODIES.index(body)) & ~self.fell)

    def share_near(self, body: str) -> Interval:
        """Of the trials at a body, those within `NEAR` of theory."""
        at = self.at(body)
        if not len(at):
            return Interval(np.nan, np.nan, np.nan)
        return bootstrap.share(np.abs(self.measured[at] / self.theory[at] - 1.0) < NEAR)

    def stiffness(self, body: str) -> Interval:
        """Median of the measured stiffness at a body, N/m."""
        at = self.at(body)
        if not len(at):
            return Interval(np.nan, np.nan, np.nan)
        again = self.measured[at][bootstrap.draws(len(at))]
        low, high = np.percentile(np.median(again, axis=1), [2.5, 97.5])
        return Interval(float(np.median(self.measured[at])), float(low), float(high))

    def expected(self, body: str) -> float:
        """Median of the theoretical stiffness over the same trials, N/m."""
        at = self.at(body)
        return float(np.median(self.theory[at])) if len(at) else np.nan


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
    low, high = run.alphas
    levels = [x for x in LEVELS if low <= x <= high] if alpha is None else list(alpha)
    for level in levels:
        run.config.env.compliance.check_alpha(level)
    changes = {f"task.{name}": value for name, value in (task or {}).items()}
    changed = run.config.with_(changes)
    environment = make_environment(run, Pulled(changed.task.quiet()))
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
    """Of log measured over log theoretical median stiffness at a body, over alpha."""
    found = np.log([d.stiffness(body).value for d in drags])
    expected = np.log([d.expected(body) for d in drags])
    good = np.isfinite(found) & np.isfinite(expected)
    if good.sum() < 2:
        return np.nan
    return float(np.polyfit(expected[good], found[good], 1)[0])


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
    C = _compliances(character, q[:, ~pulled], alpha)
    f = along.mean(axis=0)
    expected = np.einsum("ki,kij,kj->k", f, C[alone, body], f) / newtons
    fell = ended[pulled] | ended[alone]
    with np.errstate(divide="ignore"):
        found = np.where(fell, np.nan, newtons / yields)
    return Drag(alpha, body, alone, newtons, found, newtons / expected, fell)


def _from_pelvis(character: Character, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of mass [T, K, bodies, 3] in the pelvis's frame, m, and its rotation
    [T, K, 3, 3], at coordinates [T, K, 55]."""
    model = compose_scene(character, floor=False)
    kinematics = features.Kinematics.of(model)
    at = [character.body_names.index(name) for name in BODIES]
    offset = jnp.array([model.body(name).ipos for name in BODIES], jnp.float32)

    @jax.jit
    def seen(q: Array) -> Array:
        pos_w, quat_w = features.body_poses(kinematics, q)
        point_w = pos_w[jnp.array(at)] + quat.rotate(quat_w[jnp.array(at)], offset)
        return quat.rotate(quat.inv(q[3:7]), point_w - q[:3])

    turn = Rotation.from_quat(q[..., 3:7].reshape(-1, 4), scalar_first=True)
    points = np.asarray(jax.vmap(jax.vmap(seen))(q))
    return points, turn.as_matrix().reshape(*q.shape[:2], 3, 3)


def _compliances(character: Character, q: np.ndarray, alpha: float) -> np.ndarray:
    """K_hat^-1 [E, bodies, 3, 3] in the pelvis's frame, mean over the poses [T, E, 55].

    Every fifth pose: a stride has a dozen.
    """
    model = compose_scene(character, floor=False)
    kp = softened_gains(character.kp, character.column_weight, alpha)
    found = np.zeros((q.shape[1], len(BODIES), 3, 3))
    poses = q[::5].astype(float)
    poses[..., :7] = model.qpos0[:7]
    for e, b in np.ndindex(*found.shape[:2]):
        point = model.body(BODIES[b]).ipos
        for pose in poses[:, e]:
            K = stiffness(model, pose, BODIES[b], point, kp)
            found[e, b] += np.linalg.inv(K) / len(poses)
    return found
