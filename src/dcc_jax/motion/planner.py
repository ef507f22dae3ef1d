"""A motion planner for walking and running: loops of one gait each, blended by speed.

The Appendix of the paper lets a planner give q_m(t). This one takes loops at a few
speeds, a stand among them, brings their strides into phase, and blends the two whose
speeds are next to the wanted one. All loops go along x. The path moves evenly, and the
root sways beside it as it does in the loops: without that, standing soles would slide.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.character import CONTROL_DT, load_character
from dcc_jax.motion import paths
from dcc_jax.motion.paths import Gaits, Motion, direction, path, whole_steps
from dcc_jax.motion.reference import References, RefState, planar_moved

Array = jax.Array

LOOPS = (
    "stand",
    "walk_slow_cycle",
    "walk_cycle",
    "walk_fast_cycle",
    "jog_cycle",
    "run_cycle",
)
"""Clips of the package that go together as strides."""
STANDS = 0.05  # m/s; a loop that is slower has no strides
_SAMPLES = 64  # of a period, to find its phase and its middle


@dataclass(frozen=True)
class Strides:
    """Loops in the order of their speeds."""

    clips: tuple[int, ...]  # index into the references
    speeds: tuple[float, ...]  # m/s
    cadences: tuple[float, ...]  # strides a second; a stand has the next loop's
    offsets: tuple[float, ...]  # share of the period at which a stride begins
    centers: tuple[tuple[float, float], ...]  # m, root less an even motion, on average

    def cadence(self, speed: Array) -> Array:
        """Strides a second at a speed."""
        return jnp.interp(speed, jnp.array(self.speeds), jnp.array(self.cadences))

    def pose(
        self, references: References, phase: Array, speed: Array, time: Array
    ) -> Array:
        """qpos [55] at a phase of the stride, heading along x.

        The root is where it sways to beside a point that moves evenly, which is the
        origin.

        Args:
            references: of which these are the loops.
            phase: of the stride, in periods.
            speed: m/s; beyond the fastest loop, that one.
            time: s, for a stand, which has no strides.
        """
        speeds = jnp.array(self.speeds)
        last = len(self.speeds) - 1
        above = jnp.clip(jnp.searchsorted(speeds, speed, side="right"), 1, last)
        share = (speed - speeds[above - 1]) / (speeds[above] - speeds[above - 1])
        slow, fast = (self._of(references, i, phase, time) for i in (above - 1, above))
        scalars, quats = references.coords.split_q(slow)
        more_scalars, more_quats = references.coords.split_q(fast)
        share = jnp.clip(share, 0.0, 1.0)
        scalars = scalars + share * (more_scalars - scalars)
        blended = quat.slerp(quats, more_quats, share)
        return references.coords.join_q(scalars, blended)

    def _of(
        self, references: References, index: Array, phase: Array, time: Array
    ) -> Array:
        clip = jnp.array(self.clips)[index]
        stride = (phase + jnp.array(self.offsets)[index]) % 1.0
        strides = jnp.array(self.speeds)[index] > STANDS
        duration = references.duration[clip]
        at = jnp.where(strides, stride * duration, time)
        even = jnp.array(self.centers)[index] + at / duration * references.shift[clip]
        return references.qpos_at(clip, at).at[:2].add(-even)


@jax.ensure_compile_time_eval()
def strides(references: References) -> Strides:
    """The loops of the references as strides; known before anything is traced.

    Raises:
        ValueError: a clip is no loop, fewer than two of them, none that strides, or two
            of one speed.
    """
    for name, loop in zip(references.names, np.asarray(references.loop), strict=True):
        if not loop:
            raise ValueError(f"env.clips must be loops, {name} is none")
    duration = np.asarray(references.duration)
    speeds = np.linalg.norm(np.asarray(references.shift), axis=1) / duration
    order = np.argsort(speeds)
    if len(order) < 2 or np.diff(speeds[order]).min() < 1e-3:
        raise ValueError("env.clips must be two loops or more, of different speeds")
    cadences = np.where(speeds > STANDS, 1.0 / duration, np.nan)[order]
    if not np.isfinite(cadences[1:]).all():
        raise ValueError("env.clips must have one stand at most; others must stride")
    cadences[0] = cadences[0] if np.isfinite(cadences[0]) else cadences[1]
    return Strides(
        clips=tuple(int(i) for i in order),
        speeds=tuple(float(x) for x in speeds[order]),
        cadences=tuple(float(x) for x in cadences),
        offsets=tuple(_offset(references, int(i)) for i in order),
        centers=tuple(_center(references, int(i)) for i in order),
    )


def first_reference(
    key: Array, references: References, gaits: Gaits, stands: bool
) -> RefState:
    """Any moment of a stride at one of the speeds, or of a stand.

    Args:
        key: consumed.
        references: the loops.
        gaits: whose speeds they are.
        stands: at rest in any case.
    """
    speed_key, phase_key = jax.random.split(key)
    speed = jax.random.choice(speed_key, jnp.array(gaits.speeds))
    phase = jax.random.uniform(phase_key)
    if stands:
        speed = 0.0 * speed
    return begin(references, strides(references), phase, speed, CONTROL_DT)


def first_motion(key: Array, gaits: Gaits, reference: RefState) -> Motion:
    """A motion that goes on for a while as the reference's path does at the reset."""
    ahead = quat.rotate(quat.heading(reference.qpos[3:7]), jnp.array([1.0, 0, 0]))
    facing = jnp.arctan2(ahead[1], ahead[0])
    root = reference.qpos[:2] - reference.sway
    velocity = reference.qvel[:2] - reference.sway_velocity
    return paths.begin(key, gaits, root, velocity, facing)


def begin(
    references: References, loops: Strides, phase: Array, speed: Array, dt: float
) -> RefState:
    """The reference at a phase, its path at the origin, along x at a speed in m/s."""
    zero = jnp.zeros(())
    now = loops.pose(references, phase, speed, zero)
    earlier = phase - dt * loops.cadence(speed)
    before = loops.pose(references, earlier, speed, zero - dt).at[0].add(-dt * speed)
    qvel, travel = rate(references.coords, before, now, dt), jnp.stack([speed, zero])
    return RefState(
        qpos=now,
        qvel=qvel,
        qpos_previous=before,
        clip=jnp.zeros((), jnp.int32),
        time=zero,
        travel=travel,
        phase=phase % 1.0,
        sway=now[:2],
        sway_velocity=qvel[:2] - travel,
    )


def go_on(
    references: References, loops: Strides, motion: Motion, at: RefState, elapsed: float
) -> RefState:
    """The reference `elapsed` s later, its root beside the path of a motion.

    Velocities are the path's over the ground and, by central differences, those of the
    strides.

    Args:
        references: of the loops.
        loops: of `strides`.
        motion: of the root, its time in s since the reset.
        at: the reference before, its time likewise.
        elapsed: s.
    """
    time = whole_steps(at.time) + elapsed
    position, heading, speed = path(motion, time)
    velocity = speed * direction(heading)

    def phase(later: float) -> Array:
        return (at.phase + (elapsed + later) * loops.cadence(speed)) % 1.0

    def pose(later: float) -> Array:
        pose = loops.pose(references, phase(later), speed, time + later)
        return planar_moved(pose, heading + later * motion.turn, position)

    now = pose(0.0)
    of_strides = rate(references.coords, pose(-elapsed), pose(elapsed), 2.0 * elapsed)
    return dataclasses.replace(
        at,
        qpos=now,
        qvel=of_strides.at[:2].add(velocity),
        qpos_previous=at.qpos,
        time=time,
        travel=velocity,
        phase=phase(0.0),
        sway=now[:2] - position,
        sway_velocity=of_strides[:2],
    )


def rate(coords: quat.Coordinates, before: Array, now: Array, dt: float) -> Array:
    """The velocity [42] that leads from one pose to another within dt s."""
    scalars, quats = coords.split_q(before)
    later_scalars, later_quats = coords.split_q(now)
    turned = quat.log(quat.mul(quat.inv(quats), later_quats))
    return coords.join_v((later_scalars - scalars) / dt, turned / dt)


def _offset(references: References, clip: int) -> float:
    """Where in its period the left hip is farthest back against the right one."""
    qpos, _ = _sampled(references, clip)
    names = load_character().joint_names
    _, quats = references.coords.split_q(qpos)
    bend = quat.log(quats)[..., 1]
    left, right = (1 + names.index(name) for name in ("left_hip", "right_hip"))
    wave = np.fft.fft(np.asarray(bend[:, left] - bend[:, right]))[1]
    return float(-np.angle(wave) / (2.0 * np.pi) % 1.0)


def _center(references: References, clip: int) -> tuple[float, float]:
    """Where the root is on average, less the even motion of the loop's own speed, m."""
    qpos, share = _sampled(references, clip)
    even = share[:, None] * np.asarray(references.shift[clip])
    x, y = np.mean(np.asarray(qpos[:, :2]) - even, axis=0)
    return float(x), float(y)


def _sampled(references: References, clip: int) -> tuple[Array, np.ndarray]:
    """Poses [_SAMPLES, 55] of a period, and at which shares of it they are."""
    share = np.arange(_SAMPLES) / _SAMPLES
    times = jnp.asarray(share * float(references.duration[clip]))
    return jax.vmap(lambda t: references.qpos_at(clip, t))(times), share
