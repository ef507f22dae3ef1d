"""Episodes in which a force drags at the character's body, as one compiled program.

The force ramps up, holds and lets go, while the policy's mean action goes on.
Letters: K trials, T control steps.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

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


Play = Callable[[Run, Trials, float, int], tuple[np.ndarray, np.ndarray]]


def program(environment: Environment) -> Play:
    """Plays all trials of a level of a `Pulled` task; compiled once.

    It takes a run, trials, a level and a seed, and gives coordinates [T, K, 55] and
    whether the episode ended before its time [K].
    """
    scene, steps = environment.scene, round((BEGIN + RAMP + HOLD) * CONTROL_RATE)
    devices = jax.devices()
    mesh = jax.make_mesh((len(devices),), ("env",), devices=devices)
    split, over_time = PartitionSpec("env"), PartitionSpec(None, "env")
    ids = np.array([scene.body(name) for name in BODIES])
    centres = np.array([scene.model.body_ipos[i] for i in ids])

    def reset(key: Array, body: Array, alpha: Array) -> EnvState:
        state = environment.reset(jax.random.fold_in(key, 0), alpha)
        at, place = jnp.asarray(ids)[body], jnp.asarray(centres, jnp.float32)[body]
        hands = state.task.hands
        hands = dataclasses.replace(
            hands,
            body=hands.body.at[PUSH].set(at),
            point=hands.point.at[PUSH].set(place),
        )
        return _with_hands(state, hands)

    def dragged(state: EnvState, force: Array) -> EnvState:
        share = jnp.clip((state.time - BEGIN) / RAMP, 0.0, 1.0)
        hands = state.task.hands
        force_w = hands.force_w.at[PUSH].set(share * force)
        return _with_hands(state, dataclasses.replace(hands, force_w=force_w))

    def episodes(
        policy: Policy,
        keys: Array,
        body: Array,
        force: Array,
        alpha: Array,
        told: Array,
    ) -> tuple[Array, Array]:
        def step(carry: tuple[EnvState, Array], time: Array):
            state, ended = carry
            action = policy.mean(state.obs.at[:, ALPHA_ENTRY].set(told))
            draws = jax.vmap(lambda key: jax.random.fold_in(key, time))(keys)
            state = jax.vmap(dragged)(state, force)
            state = jax.vmap(environment.step)(draws, state, action)
            ended = ended | state.terminated
            q = jax.vmap(scene.character_qpos)(state.body.qpos)
            return (state, ended), q

        start = jax.vmap(reset)(keys, body, alpha)
        carry = start, jnp.zeros(len(keys), bool)
        (_, ended), q = jax.lax.scan(step, carry, 1 + jnp.arange(steps))
        return q, ended

    compiled = jax.jit(
        jax.shard_map(
            episodes,
            mesh=mesh,
            in_specs=(PartitionSpec(), split, split, split, split, split),
            out_specs=(over_time, split),
            check_vma=False,
        )
    )

    def play(
        run: Run, trials: Trials, alpha: float, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        count = len(trials.body)
        filled = np.resize(np.arange(count), -(-count // len(devices)) * len(devices))
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(
            trials.episode[filled]
        )
        level = np.full(len(filled), alpha, np.float32)
        given = jax.device_put(
            (
                keys,
                np.maximum(trials.body[filled], 0),
                trials.force[filled].astype(np.float32),
                level,
                np.clip(level, *run.alphas),
            ),
            NamedSharding(mesh, split),
        )
        q, ended = compiled(run.policy, *given)
        return np.asarray(q)[:, :count], np.asarray(ended)[:count]

    return play


def _with_hands(state: EnvState, hands: Hands) -> EnvState:
    return dataclasses.replace(state, task=dataclasses.replace(state.task, hands=hands))
