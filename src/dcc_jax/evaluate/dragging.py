"""Episodes in which a force drags at the character's body, as one compiled program.

The force ramps up and holds, while the policy's mean action goes on.
Letters: K trials, T control steps.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from dcc_jax.character import CONTROL_RATE
from dcc_jax.env.environment import Environment
from dcc_jax.env.observation import ALPHA_ENTRY
from dcc_jax.env.state import EnvState
from dcc_jax.learn.rollout import Policy
from dcc_jax.play.pull import PUSH, Hands
from dcc_jax.play.runs import Run

Array = jax.Array

BODIES = ("left_hand", "right_hand", "chest", "head")
NEWTONS = (20.0, 50.0, 100.0, 150.0)
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
BEGIN, RAMP, HOLD = 4.0, 0.5, 2.5  # s
STEPS = round((BEGIN + RAMP + HOLD) * CONTROL_RATE)


@dataclass(frozen=True)
class Trials:
    """What is tried in one program: first every episode without a force."""

    episode: np.ndarray  # [K]
    body: np.ndarray  # [K] index into BODIES, -1: no force
    force: np.ndarray  # [K, 3] N, world

    @classmethod
    def of(cls, episodes: int) -> Trials:
        """Every body, direction and force in every episode."""
        rows = [(e, -1, np.zeros(3)) for e in range(episodes)]
        rows += [
            (e, b, n * d)
            for e, b, n, d in itertools.product(
                range(episodes), range(len(BODIES)), NEWTONS, DIRECTIONS
            )
        ]
        episode, body, force = zip(*rows, strict=True)
        return cls(np.array(episode), np.array(body), np.stack(force))


@flax.struct.dataclass
class Given:
    """What makes a trial; leaves [K, ...]."""

    key: Array  # of the episode
    body: Array  # index into BODIES
    force_w: Array  # [3] N
    alpha: Array  # level of compliance
    told: Array  # alpha that the policy observes


class Dragging:
    """Plays all trials of a level of a `Pulled` task, as one program for any policy."""

    def __init__(self, environment: Environment) -> None:
        """Of an environment whose task is `Pulled`; compiled at the first call."""
        scene = environment.scene
        self.environment = environment
        self.ids = np.array([scene.body(name) for name in BODIES])
        self.centers = scene.model.body_ipos[self.ids].astype(np.float32)
        self.devices = jax.devices()
        count = len(self.devices)
        self.mesh = jax.make_mesh((count,), ("env",), devices=self.devices)
        split = PartitionSpec("env")
        self._compiled = jax.jit(
            jax.shard_map(
                self._episodes,
                mesh=self.mesh,
                in_specs=(PartitionSpec(), split),
                out_specs=(PartitionSpec(None, "env"), split),
                check_vma=False,
            )
        )

    def __call__(
        self, run: Run, trials: Trials, alpha: float, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates [T, K, 55], and whether an episode ended before its time [K]."""
        count, devices = len(trials.body), len(self.devices)
        filled = np.resize(np.arange(count), -(-count // devices) * devices)
        level = np.full(len(filled), alpha, np.float32)
        given = Given(
            key=jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(
                trials.episode[filled]
            ),
            body=jnp.asarray(np.maximum(trials.body[filled], 0)),
            force_w=jnp.asarray(trials.force[filled], jnp.float32),
            alpha=jnp.asarray(level),
            told=jnp.asarray(np.clip(level, *run.alphas)),
        )
        placed = jax.device_put(given, NamedSharding(self.mesh, PartitionSpec("env")))
        q, ended = self._compiled(run.policy, placed)
        return np.asarray(q)[:, :count], np.asarray(ended)[:count]

    def _episodes(self, policy: Policy, given: Given) -> tuple[Array, Array]:
        """The trials of one device: q [T, K, 55] and whether they ended early [K]."""
        environment, scene = self.environment, self.environment.scene

        def step(carry: tuple[EnvState, Array], time: Array):
            state, ended = carry
            action = policy.mean(state.obs.at[:, ALPHA_ENTRY].set(given.told))
            draws = jax.vmap(lambda key: jax.random.fold_in(key, time))(given.key)
            state = jax.vmap(_dragged)(state, given.force_w)
            state = jax.vmap(environment.step)(draws, state, action)
            ended = ended | state.terminated | state.truncated
            return (state, ended), jax.vmap(scene.character_qpos)(state.body.qpos)

        start = jax.vmap(self._reset)(given)
        carry = start, jnp.zeros(len(given.key), bool)
        (_, ended), q = jax.lax.scan(step, carry, 1 + jnp.arange(STEPS))
        return q, ended

    def _reset(self, given: Given) -> EnvState:
        """An episode with a hand at the centre of mass of the body to drag at."""
        key = jax.random.fold_in(given.key, 0)
        state = self.environment.reset(key, given.alpha)
        hands = state.task.hands
        body, point = jnp.asarray(self.ids), jnp.asarray(self.centers)
        hands = dataclasses.replace(
            hands,
            body=hands.body.at[PUSH].set(body[given.body]),
            point=hands.point.at[PUSH].set(point[given.body]),
        )
        return _with_hands(state, hands)


def _dragged(state: EnvState, force_w: Array) -> EnvState:
    share = jnp.clip((state.time - BEGIN) / RAMP, 0.0, 1.0)
    hands = state.task.hands
    now = hands.force_w.at[PUSH].set(share * force_w)
    return _with_hands(state, dataclasses.replace(hands, force_w=now))


def _with_hands(state: EnvState, hands: Hands) -> EnvState:
    return dataclasses.replace(state, task=dataclasses.replace(state.task, hands=hands))
