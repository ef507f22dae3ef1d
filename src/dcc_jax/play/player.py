"""Episodes of the mean action, recorded: what evaluation and video are made of.

Episodes of equal number meet the same initial state and the same perturbations whatever
alpha and policy are, so that levels of compliance compare in pairs.
Letters: N episodes, T control steps, C chunks of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.env.environment import Environment
from dcc_jax.env.state import EnvState
from dcc_jax.learn.rollout import Policy
from dcc_jax.play import stepping
from dcc_jax.play.recording import Frame, Recording
from dcc_jax.play.runs import Run

Array = jax.Array

CHUNK = 15  # control steps a call: one program serves episodes of any length
WIDTHS = (8, 32, 128)  # environments of a device; the last fills a core's cache


class Player:
    """Plays episodes of one environment; the compiled program serves all calls."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self._step = partial(stepping.advance, environment)
        devices = jax.devices()
        self._mesh = jax.make_mesh((len(devices),), ("env",), devices=devices)
        shared, split = PartitionSpec(), PartitionSpec("env")
        over_time = PartitionSpec(None, "env")
        self._reset = jax.jit(
            jax.shard_map(
                self._reset_all,
                mesh=self._mesh,
                in_specs=(split, split),
                out_specs=split,
                check_vma=False,
            )
        )
        self._advance = jax.jit(
            jax.shard_map(
                self._chunk,
                mesh=self._mesh,
                in_specs=(shared, split, split, split, shared),
                out_specs=(split, over_time, split),
                check_vma=False,
            ),
            donate_argnums=1,
        )

    def play(
        self,
        run: Run,
        episodes: Sequence[int] | np.ndarray,
        alpha: Sequence[float] | np.ndarray,
        *,
        observed_alpha: Sequence[float] | np.ndarray | None = None,
        seed: int = 0,
        seconds: float = 10.0,
        motion: bool = False,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Recording:
        """Plays episodes with the mean action.

        Args:
            run: whose policy acts.
            episodes: number [N] of each; with the seed it decides on all that is drawn.
            alpha: level of compliance [N] of each; at 0 u stays exactly zero.
            observed_alpha: [N] that the policy observes; None: the level. It observes
                the nearest alpha that it was trained with.
            seed: of everything that is drawn.
            seconds: after which an episode ends.
            motion: keep what pictures need.
            progress: told how many control steps are done, again and again.
        """
        episodes, alpha = np.asarray(episodes), np.asarray(alpha, np.float32)
        told = alpha if observed_alpha is None else np.asarray(observed_alpha)
        told = np.clip(told, *run.alphas).astype(np.float32)
        steps = max(1, round(seconds * CONTROL_RATE))
        width = self._width(len(episodes))
        parts = []
        for start in range(0, len(episodes), width):
            # The last batch is filled up with its own first episodes.
            rows = np.arange(start, min(start + width, len(episodes)))
            filled = np.resize(rows, width)
            part = self._batch(
                run,
                episodes[filled],
                alpha[filled],
                told[filled],
                seed,
                steps,
                motion,
                lambda done, start=start, rows=rows: progress(
                    start * steps + min(done, steps) * len(rows)
                ),
            )
            parts.append(jax.tree.map(partial(_first, len(rows)), part))
        joined = jax.tree.map(lambda *xs: np.concatenate(xs, axis=1), *parts)
        return _recording(joined)

    def _width(self, count: int) -> int:
        devices = self._mesh.size
        fitting = [w for w in WIDTHS if w * devices >= count]
        return devices * (fitting[0] if fitting else WIDTHS[-1])

    def _batch(
        self,
        run: Run,
        episodes: np.ndarray,
        alpha: np.ndarray,
        observed_alpha: np.ndarray,
        seed: int,
        steps: int,
        motion: bool,
        progress: Callable[[int], None],
    ) -> dict[str, Any]:
        """Plays one batch until all its episodes are over; leaves [T or C, N, ...]."""
        keys = jax.vmap(partial(stepping.episode_key, seed))(episodes)
        split = NamedSharding(self._mesh, PartitionSpec("env"))
        keys, level, observed_alpha = jax.device_put(
            (keys, alpha, observed_alpha), split
        )
        state = self._reset(keys, level)
        alive, chunks = np.ones(len(episodes), bool), []
        for chunk in range(-(-steps // CHUNK)):
            if alive.any():
                state, frames, pairs = self._advance(
                    run.policy, state, keys, observed_alpha, chunk
                )
                kept = jax.device_get(
                    frames if motion else dataclasses.replace(frames, motion=None)
                )
                chunks.append(_ends(kept, np.asarray(pairs), alive))
                alive = chunks[-1]["alive_after"][-1]
            else:
                chunks.append(jax.tree.map(np.zeros_like, chunks[-1]))
            progress(CHUNK * (chunk + 1))
        joined = jax.tree.map(lambda *xs: np.concatenate(xs), *chunks)
        return _cut(joined, steps)

    def _reset_all(self, keys: Array, alpha: Array) -> EnvState:
        return jax.vmap(partial(stepping.begin, self.environment))(keys, alpha)

    def _chunk(
        self,
        policy: Policy,
        state: EnvState,
        keys: Array,
        observed_alpha: Array,
        chunk: Array,
    ) -> tuple[EnvState, Frame, Array]:
        """CHUNK control steps of all environments of a device."""

        def step(state: EnvState, count: Array) -> tuple[EnvState, Frame]:
            def one(
                state: EnvState, key: Array, observed_alpha: Array
            ) -> tuple[EnvState, Frame]:
                return self._step(policy, state, key, observed_alpha, count)

            return jax.vmap(one)(state, keys, observed_alpha)

        # Zero is the key of the reset.
        counts = 1 + CHUNK * chunk + jnp.arange(CHUNK)
        state, frames = jax.lax.scan(step, state, counts)
        pairs = self.environment.style_coordinates(
            state.previous_features, state.features
        )
        return state, frames, pairs


def _ends(frames: Frame, pairs: np.ndarray, alive: np.ndarray) -> dict[str, Any]:
    """A chunk with its bookkeeping, given which episodes [N] still ran before it."""
    ended = np.logical_or.accumulate(frames.terminated | frames.truncated)
    before = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]])
    during = alive & ~before
    return {
        "alive": during,
        "alive_after": alive & ~ended,
        "fell": during & frames.terminated,
        "nan": during & frames.nan,
        "numbers": frames.numbers,
        "motion": frames.motion,
        "pairs": pairs[None],
        "pairs_alive": during[-1:],
    }


def _first(count: int, x: np.ndarray) -> np.ndarray:
    return x[:, :count]


def _cut(joined: dict[str, Any], steps: int) -> dict[str, Any]:
    """Without the control steps after the end, and without what they did."""
    lengths = {"pairs": steps // CHUNK, "pairs_alive": steps // CHUNK}
    return {
        name: jax.tree.map(partial(_until, lengths.get(name, steps)), value)
        for name, value in joined.items()
    }


def _until(count: int, x: np.ndarray) -> np.ndarray:
    return x[:count]


def _recording(joined: dict[str, Any]) -> Recording:
    return Recording(
        alive=joined["alive"],
        fell=joined["fell"].any(axis=0),
        nan=joined["nan"].any(axis=0),
        numbers=joined["numbers"],
        motion=joined["motion"],
        pairs=joined["pairs"],
        pairs_alive=joined["pairs_alive"],
    )
