"""Episodes of the mean action, recorded: what evaluation and video are made of.

Episodes of equal number meet the same initial state and the same perturbations whatever
alpha and policy are, so that levels of compliance compare in pairs.
Letters: N episodes, T control steps, S physics steps in one, F forces, C chunks,
E coordinates of a style pair.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from dcc_jax import physics, quat
from dcc_jax.env import mechanics
from dcc_jax.env.environment import ALPHA_ENTRY, CONTROL_RATE, Environment, EnvState
from dcc_jax.env.mechanics import Mechanics
from dcc_jax.env.task import Forces
from dcc_jax.evaluate.runs import Run
from dcc_jax.learn.rollout import Policy

Array = jax.Array

CHUNK = 15  # control steps a call: one program serves episodes of any length
WIDTHS = (8, 32, 128)  # environments of a device; the last fills a core's cache


@flax.struct.dataclass
class Motion:
    """What a picture needs, of the strongest moment of each control step."""

    qpos: Array  # [..., nq] of the scene at the end of the control step
    u: Array  # [..., 55]
    reference: Array  # [..., 55] q_m(t), where the task follows its clip in time
    force_w: Array  # [..., F, 3] N, that the compliance hears
    point_w: Array  # [..., F, 3] m
    mocap_pos: Array  # [..., nmocap, 3] m, of the scene's kinematic bodies
    mocap_quat: Array  # [..., nmocap, 4]


@flax.struct.dataclass
class Frame:
    """What is kept of a control step of one environment."""

    numbers: dict[str, Array]  # [] each
    motion: Motion
    terminated: Array  # [] bool
    truncated: Array  # [] bool, by the end of a clip that is followed
    nan: Array  # [] bool


@dataclass(frozen=True)
class Recording:
    """N episodes; what comes after the end of one is not alive."""

    alive: np.ndarray  # [T, N] bool, the control step belongs to the episode
    fell: np.ndarray  # [N] bool, it ended by termination
    nan: np.ndarray  # [N] bool, it ended because the physics broke
    numbers: dict[str, np.ndarray]  # [T, N] each
    motion: Motion | None  # [T, N, ...], where it was asked for
    pairs: np.ndarray  # [C, N, E] m, style coordinates at the end of each chunk
    pairs_alive: np.ndarray  # [C, N] bool


class Player:
    """Plays episodes of one environment; the compiled program serves all calls."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self.mechanics = Mechanics.of(environment.scene.character)
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
        seed: int = 0,
        seconds: float = 10.0,
        motion: bool = False,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Recording:
        """Plays episodes with the mean action.

        Args:
            run: whose policy acts. It observes the nearest alpha it was trained with.
            episodes: number [N] of each; with the seed it decides on all that is drawn.
            alpha: level of compliance [N] of each.
            seed: of everything that is drawn.
            seconds: after which an episode ends.
            motion: keep what pictures need.
            progress: told how many control steps are done, again and again.
        """
        episodes, alpha = np.asarray(episodes), np.asarray(alpha, np.float32)
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
        seed: int,
        steps: int,
        motion: bool,
        progress: Callable[[int], None],
    ) -> dict[str, Any]:
        """Plays one batch until all its episodes are over; leaves [T or C, N, ...]."""
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(episodes)
        told = np.clip(alpha, *run.alphas).astype(np.float32)
        split = NamedSharding(self._mesh, PartitionSpec("env"))
        keys, level, told = jax.device_put((keys, alpha, told), split)
        state = self._reset(keys, level)
        alive, chunks = np.ones(len(episodes), bool), []
        for chunk in range(-(-steps // CHUNK)):
            if alive.any():
                state, frames, pairs = self._advance(
                    run.policy, state, keys, told, chunk
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
        first = jax.vmap(lambda key: jax.random.fold_in(key, 0))(keys)
        return jax.vmap(self.environment.reset)(first, alpha)

    def _chunk(
        self, policy: Policy, state: EnvState, keys: Array, told: Array, chunk: Array
    ) -> tuple[EnvState, Frame, Array]:
        """CHUNK control steps of all environments of a device."""

        def step(state: EnvState, time: Array) -> tuple[EnvState, Frame]:
            action = policy.mean(state.obs.at[:, ALPHA_ENTRY].set(told))
            draws = jax.vmap(lambda key: jax.random.fold_in(key, time))(keys)
            new, forces = jax.vmap(self.environment.recorded_step)(draws, state, action)
            return new, jax.vmap(self._frame)(state, new, forces)

        # Zero is the key of the reset.
        times = 1 + CHUNK * chunk + jnp.arange(CHUNK)
        state, frames = jax.lax.scan(step, state, times)
        pairs = self.environment.style_coordinates(
            state.previous_features, state.features
        )
        return state, frames, pairs

    def _frame(self, before: EnvState, state: EnvState, forces: Forces) -> Frame:
        return Frame(
            numbers=self._numbers(before, state),
            motion=self._motion(state, forces),
            terminated=state.terminated,
            truncated=state.truncated,
            nan=state.nan,
        )

    def _numbers(self, before: EnvState, state: EnvState) -> dict[str, Array]:
        """Everything of a control step that is one number; `measures` sums them up."""
        environment, tables = self.environment, self.mechanics
        scene, task = environment.scene, environment.task
        q = scene.character_qpos(state.body.qpos)
        kinetic, potential = mechanics.energy(
            tables, q, scene.character_qvel(state.body.qvel)
        )
        soles = mechanics.sole_points(tables, q)
        slip, stands = mechanics.slip(
            soles,
            mechanics.sole_points(tables, scene.character_qpos(before.body.qpos)),
            task.ground_height(scene, state.task, state.body),
            task.ground_height(scene, before.task, before.body),
        )
        own = task.evaluate(scene, state.task, state.body)
        metrics = state.metrics
        numbers = {
            "force_peak": metrics.force_peak,
            "impulse": metrics.impulse,
            "contact_share": metrics.contact_share,
            "torque_rms": metrics.torque_rms,
            "contact_torque": metrics.contact_torque,
            "torque_peak": metrics.torque_peak,
            "power": metrics.power,
            "displacement": metrics.displacement,
            "root_displacement": metrics.root_displacement,
            "kinetic": kinetic,
            "energy": kinetic + potential,
            "foot_height": jnp.min(soles[:, 2]),
            "pelvis_height": q[2],
            "slip": slip,
            "stands": stands,
            "range_excess": jnp.max(mechanics.range_excess(tables, q)),
            "r_p": state.r_p,
            "r_task": state.r_task,
        }
        numbers |= {f"task/{name}": value for name, value in own.items()}
        return {k: jnp.asarray(v, jnp.float32) for k, v in numbers.items()}

    def _motion(self, state: EnvState, forces: Forces) -> Motion:
        heard = jnp.where(forces.gate[:, None, None], forces.force_w, 0.0)
        strongest = jnp.argmax(jnp.sum(heard**2, axis=(1, 2)))
        scene = self.environment.scene
        world = self.environment.task.world(scene, state.task, state.time)
        world = physics.default_world(scene) if world is None else world
        return Motion(
            qpos=state.body.qpos,
            u=state.displacement.u,
            reference=state.reference.qpos,
            force_w=heard[strongest],
            point_w=forces.point_w[strongest],
            mocap_pos=world.mocap_pos,
            mocap_quat=world.mocap_quat,
        )


def displaced(environment: Environment, motion: Motion) -> np.ndarray:
    """The ghost of a motion: scene coordinates [..., nq] that show u.

    Where the task follows its clip in time, the displaced reference q_m(t) (+) u. Else
    the reference has no time, and the ghost is the pose q (-) u that the discriminator
    judges: what the character would do without u, the gap between the two being u.
    """
    scene, coords = environment.scene, environment.kinematics.coords
    qpos = jnp.asarray(motion.qpos)
    if environment.tracks:
        ghost = quat.oplus(coords, motion.reference, motion.u)
    else:
        ghost = quat.ominus(coords, scene.character_qpos(qpos), motion.u)
    end = scene.qpos_adr + scene.character.nq
    return np.asarray(qpos.at[..., scene.qpos_adr : end].set(ghost))


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
