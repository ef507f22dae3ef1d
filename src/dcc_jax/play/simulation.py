"""One character to play with: step, pull, push, alpha, reset; no picture in it.

An episode without pulls is the one that `evaluate` plays: same seed and number, same
states. Alpha, pulls and u off are inputs of the compiled program, not new programs.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dcc_jax.control import compliance
from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.env.environment import Environment
from dcc_jax.env.state import EnvState
from dcc_jax.env.task import Task
from dcc_jax.play import actions, pull, stepping
from dcc_jax.play.program import Program
from dcc_jax.play.pull import PULL, PUSH, Hands
from dcc_jax.play.recording import Frame, Motion, displaced
from dcc_jax.play.runs import Run

HISTORY = 10 * CONTROL_RATE  # control steps that are remembered
AFTERMATH = 6  # control steps that a fall is still shown; only soles meet the ground
PULL_DAMPING = 0.02  # s: a spring of k N/m resists by 0.02 k N s/m


@dataclass(frozen=True)
class Moment:
    """The end of a control step, on the host."""

    episode: int
    time: float  # s since the reset
    numbers: Mapping[str, float]  # as of `recording.Frame`
    motion: Motion  # the task's forces, then those of pull and push
    ended: str  # why the episode is over, or nothing


class Simulation:
    """A policy in its environment, one control step at a time, with a hand in it."""

    def __init__(self, run: Run, program: Program, *, seed: int = 0) -> None:
        """Begins episode 0 at the greatest alpha of the training.

        Args:
            run: whose policy acts.
            program: of its environment; compiled here if it is not yet.
            seed: of everything that is drawn.
        """
        self.run, self.program = run, program
        self.alpha = run.alphas[1]
        """Level of compliance; from the next control step on."""
        self.u_on = True
        """Off: the policy is told alpha, and nothing is displaced."""
        self.events_on = True
        """Off: the task's own throws, bounces and bumps wait until they are asked."""
        self.history: deque[Moment] = deque(maxlen=HISTORY)
        self.falls = 0
        self.steps_since_fall = 0
        self.step_seconds = 0.0
        """s that the last control step took to compute."""
        if not program.ready:
            program.compile(run)
        self.reset(seed=seed, episode=0)

    @property
    def environment(self) -> Environment:
        """Where it happens."""
        return self.program.environment

    @property
    def task(self) -> Task:
        """What it does."""
        return self.program.task

    @property
    def told(self) -> float:
        """The alpha that the policy observes: the nearest of its training."""
        return float(np.clip(self.alpha, *self.run.alphas))

    @property
    def level(self) -> float:
        """The alpha that acts on the body."""
        return self.alpha if self.u_on else 0.0

    def reset(self, *, seed: int | None = None, episode: int | None = None) -> None:
        """Begins an episode: the next one, or that of a seed and number."""
        self.seed = self.seed if seed is None else seed
        self.episode = self.episode + 1 if episode is None else episode
        self._key = stepping.episode_key(self.seed, self.episode)
        self._count = 0
        self._aftermath: int | None = None
        self._push_left = 0
        self.hands = pull.no_hands()
        self.state = self.program.reset(self._key, self.level)

    def step(self) -> Moment:
        """One control step; begins the next episode where one is over."""
        if self._aftermath == 0:
            self.reset()
        began = time.perf_counter()
        self._count += 1
        new, frame = self.program.step(
            self.run, self._prepared(), self._key, self.told, self._count
        )
        frame = jax.device_get(frame)
        self.state = new
        self.step_seconds = time.perf_counter() - began
        self._push_left = max(0, self._push_left - 1)
        moment = self._moment(frame)
        self._judge(frame)
        self.history.append(moment)
        return moment

    def pull(
        self,
        body: str,
        point: np.ndarray,
        target_w: np.ndarray,
        stiffness: float,
        damping: float | None = None,
    ) -> None:
        """A spring pulls at a point of a body from now on, until `release`.

        Args:
            body: of the scene.
            point: where on it, m, in its frame [3].
            target_w: where the other end is, m, world [3].
            stiffness: N/m.
            damping: N s/m; None: as much as `PULL_DAMPING` says.

        Raises:
            ValueError: an unknown body, or numbers that are not finite.
        """
        spring = stiffness, PULL_DAMPING * stiffness if damping is None else damping
        self._hold(PULL, body, point, target_w, *spring, np.zeros(3))

    def release(self) -> None:
        """Lets go of the spring."""
        self._hold(PULL, None, np.zeros(3), np.zeros(3), 0.0, 0.0, np.zeros(3))

    def push(self, body: str, force_w: np.ndarray, seconds: float) -> None:
        """A constant force at a body's centre of mass, for a while.

        Args:
            body: of the scene.
            force_w: N, world [3].
            seconds: for how long.

        Raises:
            ValueError: an unknown body, or numbers that are not finite.
        """
        middle = self.environment.scene.model.body_ipos[self._body(body)]
        force_w = _finite("force_w", force_w)
        self._hold(PUSH, body, middle, np.zeros(3), 0.0, 0.0, force_w)
        self._push_left = max(1, round(seconds * CONTROL_RATE))

    def act(self, name: str, value: float | None = None) -> None:
        """Something that the task offers; `actions.of` lists it.

        Raises:
            ValueError: the task offers no such thing.
        """
        offered = {action.name: action for action in actions.of(self.task)}
        if name not in offered:
            raise ValueError(f"{name!r} is none of {list(offered)}")
        self._task_state = offered[name].apply(self.task, self._task_state, value)

    def ghost(self, moment: Moment) -> np.ndarray:
        """Scene coordinates [nq] of the ghost; see `recording.displaced`."""
        motion = jax.tree.map(np.asarray, moment.motion)
        return displaced(self.environment, motion)

    def warm_up(self) -> None:
        """Takes a control step, and forgets it: what is slow the first time is over."""
        self.ghost(self.step())
        self.history.clear()
        self.reset(episode=self.episode)

    @property
    def pull_force_w(self) -> np.ndarray:
        """N [3], of the spring on the character in the last control step."""
        return np.asarray(self.history[-1].motion.force_w)[-pull.HANDS + PULL]

    @property
    def seconds_since_fall(self) -> float:
        """s, or since the beginning."""
        return self.steps_since_fall / CONTROL_RATE

    @property
    def _task_state(self) -> Any:
        return self.state.task.task

    @_task_state.setter
    def _task_state(self, task: Any) -> None:
        own = dataclasses.replace(self.state.task, task=task)
        self.state = dataclasses.replace(self.state, task=own)

    def _prepared(self) -> EnvState:
        """The state with what was asked for since the last control step."""
        if self._push_left == 0:
            self._hold(PUSH, None, np.zeros(3), np.zeros(3), 0.0, 0.0, np.zeros(3))
        if not self.events_on:
            self._task_state = actions.waiting(self.task, self._task_state)
        own = dataclasses.replace(self.state.task, hands=self.hands)
        state = dataclasses.replace(self.state, task=own, alpha=np.float32(self.level))
        if not self.u_on:
            rest = compliance.at_rest(self.environment.kinematics.coords)
            state = dataclasses.replace(state, displacement=rest)
        return state

    def _hold(
        self,
        hand: int,
        body: str | None,
        point: np.ndarray,
        target_w: np.ndarray,
        stiffness: float,
        damping: float,
        force_w: np.ndarray,
    ) -> None:
        numbers = {
            "point": point,
            "target_w": target_w,
            "stiffness": stiffness,
            "damping": damping,
            "force_w": force_w,
        }
        row: Any = Hands(
            body=0 if body is None else self._body(body),  # pyright: ignore
            **{name: _finite(name, value) for name, value in numbers.items()},  # pyright: ignore
        )

        def placed(rows: np.ndarray, own: np.ndarray) -> np.ndarray:
            rows = rows.copy()
            rows[hand] = own
            return rows

        self.hands = jax.tree.map(placed, self.hands, row)

    def _body(self, name: str) -> int:
        return self.environment.scene.body(name)

    def _moment(self, frame: Frame) -> Moment:
        return Moment(
            episode=self.episode,
            time=self._count / CONTROL_RATE,
            numbers={name: float(x) for name, x in frame.numbers.items()},
            motion=frame.motion,
            ended=_ended(frame),
        )

    def _judge(self, frame: Frame) -> None:
        """Notes an end. What broke starts anew at once, a fall is shown for a while."""
        self.steps_since_fall += 1
        if self._aftermath is not None:
            self._aftermath -= 1
        elif frame.terminated or frame.truncated:
            self._aftermath = AFTERMATH if frame.terminated else 0
            if frame.terminated:
                self.falls += 1
                self.steps_since_fall = 0
        if frame.nan:
            self._aftermath = 0


def _ended(frame: Frame) -> str:
    if frame.nan:
        return "the physics broke"
    if frame.terminated:
        return "fell"
    return "the clip is over" if frame.truncated else ""


def _finite(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value, np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {value}")
    return array
