"""Reference motion q_m(t) of a set of clips: states, windows, initialization.

All of it runs inside jit on a padded pytree. Letters: C clips, T frames of the longest
clip, N samples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dcc_jax import quat
from dcc_jax.character import CONTROL_DT, compose_scene, load_character
from dcc_jax.motion.clip import Clip, seam, velocities

Array = jax.Array

ROOT_LINEAR = slice(0, 3)  # of qpos and of qvel: world axes
ROOT_QUAT = slice(3, 7)  # of qpos


@struct.dataclass
class RefState:
    """A moment of the reference, as Reference State Initialization needs it."""

    qpos: Array  # [55]
    qvel: Array  # [42] m/s and rad/s, as MuJoCo's qvel
    qpos_previous: Array  # [55] one control step ago
    clip: Array  # [] int32, which clip
    time: Array  # [] s, since the start of the clip
    travel: Array  # [2] m/s, mean velocity of a loop over the ground; else zero
    phase: Array  # [] in [0, 1]
    sway: Array  # [2] m, of the root beside its path, where there is one; else zero
    sway_velocity: Array  # [2] m/s, the same of its velocity


@struct.dataclass
class References:
    """Clips made equally long by repeating the last frame, ready for jit."""

    qpos: Array  # [C, T, 55]
    qvel: Array  # [C, T, 42]
    phase: Array  # [C, T] in [0, 1]; where a clip has none, its share of the duration
    frames: Array  # [C] int32, how many of them are the clip's own
    fps: Array  # [C] Hz
    loop: Array  # [C] bool
    turn: Array  # [C] rad, heading gained in one period of a loop
    shift: Array  # [C, 2] m, ground covered in one period
    weight: Array  # [C] probability of each clip, sums to one
    control_dt: float = struct.field(pytree_node=False)  # s
    names: tuple[str, ...] = struct.field(pytree_node=False)
    coords: quat.Coordinates = struct.field(pytree_node=False)

    @property
    def duration(self) -> Array:
        """From the first to the last frame of each clip, or its period, [C] s."""
        return (self.frames - 1) / self.fps

    @jax.jit  # traced once, however often a program has it
    def qpos_at(self, clip: Array | int, time: Array | float) -> Array:
        """q_m(t) [55] of one clip; a loop goes on, other clips hold their ends."""
        cycle, frame, share = self._place(clip, time)
        before, after = self.qpos[clip, frame], self.qpos[clip, frame + 1]
        scalars, quats = self.coords.split_q(before)
        next_scalars, next_quats = self.coords.split_q(after)
        scalars = scalars + share * (next_scalars - scalars)
        pose = self.coords.join_q(scalars, quat.slerp(quats, next_quats, share))
        turn, shift = _repeated(cycle, self.turn[clip], self.shift[clip])
        return planar_moved(pose, turn, shift)

    def qvel_at(self, clip: Array | int, time: Array | float) -> Array:
        """The velocity [42] at the same moment; zero where a clip holds its ends."""
        cycle, frame, share = self._place(clip, time)
        before, after = self.qvel[clip, frame], self.qvel[clip, frame + 1]
        velocity = before + share * (after - before)
        heading = _about_z(cycle * self.turn[clip])
        linear = quat.rotate(heading, velocity[ROOT_LINEAR])
        held = ~self.loop[clip] & ((time < 0.0) | (time > self.duration[clip]))
        return jnp.where(held, 0.0, velocity.at[ROOT_LINEAR].set(linear))

    def phase_at(self, clip: Array | int, time: Array | float) -> Array:
        """The clip's phase [] in [0, 1]."""
        _, frame, share = self._place(clip, time)
        before, after = self.phase[clip, frame], self.phase[clip, frame + 1]
        return before + share * (after - before)

    def state_at(self, clip: Array | int, time: Array | float) -> RefState:
        """The reference at `time` s into a clip."""
        time = jnp.asarray(time, jnp.float32)
        return RefState(
            qpos=self.qpos_at(clip, time),
            qvel=self.qvel_at(clip, time),
            qpos_previous=self.qpos_at(clip, time - self.control_dt),
            clip=jnp.asarray(clip, jnp.int32),
            time=time,
            travel=self._travel(clip, time),
            phase=self.phase_at(clip, time),
            sway=jnp.zeros(2),
            sway_velocity=jnp.zeros(2),
        )

    def sample(
        self,
        key: Array,
        *,
        heading: bool = False,
        radius: float = 0.0,
        begin: bool = False,
    ) -> RefState:
        """Reference State Initialization: a moment drawn from the clips.

        A clip is drawn by weight, then a time with a control step before it.

        Args:
            key: random key, consumed.
            heading: turn the character about the vertical by a random angle.
            radius: move it by up to this far in x and in y, m.
            begin: take the first such moment of the clip instead of drawing one.
        """
        draws = jax.random.uniform(key, (5,))
        clip = self._drawn(draws[0])
        first = jnp.where(self.loop[clip], 0.0, self.control_dt)
        share = 0.0 if begin else draws[1]
        state = self.state_at(clip, first + share * (self.duration[clip] - first))
        if not heading and radius == 0.0:
            return state
        turn = jnp.pi * (2.0 * draws[2] - 1.0) * heading
        shift = radius * (2.0 * draws[3:] - 1.0)
        linear = quat.rotate(_about_z(turn), state.qvel[ROOT_LINEAR])
        return dataclasses.replace(
            state,
            qpos=planar_moved(state.qpos, turn, shift),
            qpos_previous=planar_moved(state.qpos_previous, turn, shift),
            qvel=state.qvel.at[ROOT_LINEAR].set(linear),
            travel=_turned(turn, state.travel),
        )

    def sample_windows(self, key: Array, spans: Array) -> tuple[Array, Array]:
        """Expert windows [N, 4, 55] for the discriminator, and the clip's phase [N] at
        the last pose: previous and now, and the same `spans` control steps later.

        None reaches past the end of a clip; a clip too short for it holds its last
        pose.

        Args:
            key: random key, consumed.
            spans: control steps from now to later, 1 or more, [N].
        """
        draws = jax.random.uniform(key, (2, len(spans)))
        clip = self._drawn(draws[0])
        length = self.control_dt * (1.0 + spans)
        room = self.duration[clip] - jnp.where(self.loop[clip], 0.0, length)
        start = draws[1] * jnp.maximum(room, 0.0)
        now = jnp.ones_like(spans)
        steps = jnp.stack([now - 1, now, spans, spans + 1], axis=1)
        times = start[:, None] + self.control_dt * steps
        at = jax.vmap(jax.vmap(self.qpos_at, (None, 0)))
        return at(clip, times), jax.vmap(self.phase_at)(clip, times[:, 3])

    def _travel(self, clip: Array | int, time: Array) -> Array:
        cycle, _, _ = self._place(clip, time)
        mean = self.shift[clip] / self.duration[clip]
        moves = jnp.where(self.loop[clip], mean, 0.0)
        return _turned(cycle * self.turn[clip], moves)

    def _drawn(self, share: Array) -> Array:
        """The clip [...] of a uniform number [...] in [0, 1), by weight."""
        ends = jnp.cumsum(self.weight)[:-1]
        return jnp.sum(share[..., None] >= ends, axis=-1)

    def _place(
        self, clip: Array | int, time: Array | float
    ) -> tuple[Array, Array, Array]:
        """Whole periods passed, the frame before `time`, the share of the next one."""
        duration = self.duration[clip]
        cycle = jnp.where(self.loop[clip], jnp.floor(time / duration), 0.0)
        at = jnp.clip(time - cycle * duration, 0.0, duration) * self.fps[clip]
        frame = jnp.clip(at.astype(jnp.int32), 0, self.frames[clip] - 2)
        return cycle, frame, at - frame


def make_references(
    clips: Sequence[Clip],
    *,
    weights: Sequence[float] | None = None,
    control_dt: float = CONTROL_DT,
) -> References:
    """Puts clips together.

    Args:
        clips: at least one, each at its own frame rate.
        weights: how often each is drawn, relative to the others; equal by default.
        control_dt: s, distance of the poses in a window.

    Raises:
        ValueError: no clip, one too short for a window, or weights that do not fit.
    """
    if not clips:
        raise ValueError("clips is empty; give at least one")
    if not (math.isfinite(control_dt) and control_dt > 0.0):
        raise ValueError(f"control_dt must be positive, got {control_dt}")
    for clip in clips:
        least = control_dt if clip.loop else 2.0 * control_dt
        if clip.duration < least - 1e-6:
            raise ValueError(
                f"clip {clip.name!r} lasts {clip.duration:.3f} s, less than {least:.3f}"
            )
    seams = [seam(clip) if clip.loop else (0.0, np.zeros(2)) for clip in clips]
    longest = max(len(clip.qpos) for clip in clips)

    def padded(rows: np.ndarray) -> np.ndarray:
        return np.concatenate([rows, np.repeat(rows[-1:], longest - len(rows), axis=0)])

    def stacked(values: Sequence | np.ndarray, kind: type = np.float32) -> Array:
        return jnp.asarray(np.asarray(values, kind))

    return References(
        qpos=stacked([padded(clip.qpos) for clip in clips]),
        qvel=stacked([padded(velocities(clip)) for clip in clips]),
        phase=stacked([padded(_phase(clip)) for clip in clips]),
        frames=stacked([len(clip.qpos) for clip in clips], np.int32),
        fps=stacked([clip.fps for clip in clips]),
        loop=stacked([clip.loop for clip in clips], np.bool_),
        turn=stacked([turn for turn, _ in seams]),
        shift=stacked([shift for _, shift in seams]),
        weight=stacked(_normalized(weights, len(clips))),
        control_dt=float(control_dt),
        names=tuple(clip.name for clip in clips),
        coords=_coordinates(),
    )


@cache
def _coordinates() -> quat.Coordinates:
    return quat.Coordinates.of(compose_scene(load_character(), floor=False))


def planar_moved(qpos: Array, turn: Array, shift: Array) -> Array:
    """The pose [55] turned about the world's z axis by `turn`, then moved by [2] m."""
    rotation = _about_z(turn)
    root = quat.rotate(rotation, qpos[ROOT_LINEAR]).at[:2].add(shift)
    facing = quat.mul(rotation, qpos[ROOT_QUAT])
    return qpos.at[ROOT_LINEAR].set(root).at[ROOT_QUAT].set(facing)


def _about_z(angle: Array) -> Array:
    half = 0.5 * jnp.asarray(angle, jnp.float32)
    zero = jnp.zeros_like(half)
    return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)


def _turned(angle: Array, vector: Array) -> Array:
    """A vector [2] on the ground turned by `angle`."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack(
        [cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]]
    )


def _repeated(count: Array, turn: Array, shift: Array) -> tuple[Array, Array]:
    """`count` times the planar motion p -> Rz(turn) p + shift.

    The shifts add up to sum_k Rz(k turn) shift, k < count, a geometric series:
    Rz((count - 1) turn / 2) shift times sin(count turn / 2) / sin(turn / 2).
    """
    half = 0.5 * turn
    small = jnp.abs(jnp.sin(half)) < 1e-6
    ratio = jnp.sin(count * half) / jnp.where(small, 1.0, jnp.sin(half))
    ratio = jnp.where(small, count, ratio)
    return count * turn, ratio * _turned((count - 1.0) * half, shift)


def _phase(clip: Clip) -> np.ndarray:
    if clip.phase is not None:
        return clip.phase
    return np.linspace(0.0, 1.0, len(clip.qpos), dtype=np.float32)


def _normalized(weights: Sequence[float] | None, count: int) -> np.ndarray:
    if weights is None:
        return np.full(count, 1.0 / count)
    values = np.asarray(weights, float)
    if values.shape != (count,):
        raise ValueError(f"weights has {values.size} values for {count} clips")
    if not np.isfinite(values).all() or (values < 0.0).any() or values.sum() <= 0.0:
        raise ValueError(f"weights must be >= 0 with a positive sum, got {weights}")
    return values / values.sum()
