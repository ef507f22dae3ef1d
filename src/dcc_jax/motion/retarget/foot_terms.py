"""What foot cleaning asks of a correction: one function an equation.

Letters: T frames; 15 unknowns a frame: the root's shift, and shift and turn (a rotation
vector in the world) of the left and of the right foot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.frames import to_quats, to_rotation
from dcc_jax.motion.retarget.banded import Equations
from dcc_jax.motion.retarget.figure import FEET, HEEL, TOE, Figure
from dcc_jax.motion.retarget.legs import REACH

UNKNOWNS = 15
ROOT, FOOT = slice(0, 3), (slice(3, 9), slice(9, 15))
# Weights, relative to a correction of 1 m; turns count by their lever of about 0.2 m.
LEVER = 0.2  # m
SLIP = 20.0  # s, on the speed of a standing point
HEIGHT = 100.0  # on the height of a standing point, and on what is below the ground
KNEE = 0.3  # on a change of a knee's flexion, a radian
KNEE_EASE = 0.08  # s, over which such changes come and go
LEAST_SINE = 0.12  # of the flexion: nearer to straight the gain is as at 7 degrees
TOO_FAR = 100.0  # on what a leg would be longer than it is
CLEARANCE = 0.012  # m, that a foot swinging at `SWING[1]` m/s may not lose; 0 at [0]
SWING = (0.5, 1.5)
PIVOT = 1.0  # rad/s; a foot that turns faster stands on the slower of heel and toe only
ROOT_EASE, FOOT_EASE = 0.20, 0.08  # s, over which corrections come and go


@dataclass(frozen=True, eq=False)
class Pose:
    """Root [T, 3], hips and ankles [T, 2, 3] in m, and world rotations [T, 13, 4]."""

    root: np.ndarray
    hips: np.ndarray
    ankles: np.ndarray
    world: np.ndarray

    @property
    def feet(self) -> np.ndarray:
        """World rotations [T, 2, 4] of the feet."""
        return self.world[:, list(FEET)]

    def part(self, frames: slice) -> Pose:
        """The pose in some frames."""
        fields = (self.root, self.hips, self.ankles, self.world)
        return Pose(*(array[frames] for array in fields))

    def changed(self, change: np.ndarray) -> Pose:
        """The pose after the correction [T, 15]; only the feet's rotations change."""
        shift = change[:, ROOT]
        world = self.world.copy()
        ankles = self.ankles.copy()
        for side, foot in enumerate(FEET):
            part = change[:, FOOT[side]]
            ankles[:, side] += part[:, :3]
            turn = Rotation.from_rotvec(part[:, 3:])
            world[:, foot] = to_quats(turn * to_rotation(self.world[:, foot]))
        hips = self.hips + shift[:, None]
        return Pose(self.root + shift, hips, ankles, world)


def stay_close(equations: Equations, change: np.ndarray, fps: float) -> None:
    """The correction is small, and so is its acceleration."""
    frames = len(change)
    weight = np.ones(UNKNOWNS)
    ease = np.full(UNKNOWNS, FOOT_EASE)
    ease[ROOT] = ROOT_EASE
    for part in FOOT:
        weight[part] = [1.0, 1.0, 1.0, LEVER, LEVER, LEVER]
    index = np.arange(frames * UNKNOWNS)
    size = np.tile(weight, frames)
    equations.add(index[:, None], size[:, None], -size * change.ravel())
    if frames < 3:
        return
    middle = index[UNKNOWNS:-UNKNOWNS]
    columns = np.stack([middle - UNKNOWNS, middle, middle + UNKNOWNS], axis=1)
    size = np.tile(weight * (ease * fps) ** 2, frames - 2)
    values = size[:, None] * [1.0, -2.0, 1.0]
    bend = change[:-2] - 2.0 * change[1:-1] + change[2:]
    equations.add(columns, values, -size * bend.ravel())


def _foot_columns(frames: np.ndarray, side: int) -> np.ndarray:
    """Unknowns [N, 6] of one foot in some frames."""
    return frames[:, None] * UNKNOWNS + np.arange(UNKNOWNS)[FOOT[side]]


def _lever_matrix(arms: np.ndarray) -> np.ndarray:
    """[..., 3, 6]: how points at `arms` [..., 3] from the ankle move with the foot."""
    x, y, z = np.moveaxis(arms, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=-1)
    cross = cross.reshape(*arms.shape, 3)
    unit = np.broadcast_to(np.eye(3), cross.shape)
    return np.concatenate([unit, cross], axis=-1)


def heights(body: Figure, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Heights [T, 2, 4] of the points of the soles, and their levers [..., 3, 6]."""
    centres = body.sole_centres(pose.ankles, pose.feet)
    moves = _lever_matrix(centres - pose.ankles[:, :, None])
    return centres[..., 2] - body.radius, moves


def least_heights(
    body: Figure, pose: Pose, standing: np.ndarray, fps: float
) -> np.ndarray:
    """How high the points of the soles have to be, [T, 2, 4].

    Swinging ones keep their clearance as far as they have it.
    """
    centres = body.sole_centres(pose.ankles, pose.feet)
    speed = np.linalg.norm(np.gradient(centres, 1.0 / fps, axis=0), axis=-1)
    swing = np.clip((speed - SWING[0]) / (SWING[1] - SWING[0]), 0.0, 1.0)
    own = np.maximum(centres[..., 2] - body.radius, 0.0)
    return np.where(standing, 0.0, np.minimum(CLEARANCE * swing, own))


def stretches(body: Figure, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """How much too long the legs are [T, 2], and their directions [T, 2, 3]."""
    leg = pose.ankles - pose.hips
    length = np.linalg.norm(leg, axis=-1)
    return length - REACH * sum(body.leg), leg / length[..., None]


def hold(
    equations: Equations,
    low: np.ndarray,
    least: np.ndarray,
    moves: np.ndarray,
    held: np.ndarray,
) -> None:
    """Standing points are on the ground, and no point is below it."""
    for side in range(2):
        for point in range(4):
            frames = np.flatnonzero(held[:, side, point])
            wanted = (least - low)[frames, side, point]
            columns = _foot_columns(frames, side)
            values = moves[frames, side, point, 2]
            equations.add(columns, HEIGHT * values, HEIGHT * wanted)


def pivoting(body: Figure, pose: Pose, fps: float) -> np.ndarray:
    """Which parts move while the foot turns on its other part, [T, 2, 2]."""
    out = np.zeros((len(pose.root), 2, 2), bool)
    centres = body.sole_centres(pose.ankles, pose.feet)
    parts = centres.reshape(len(centres), 2, 2, 2, 3).mean(axis=3)
    speed = np.linalg.norm(np.gradient(parts[..., :2], 1.0 / fps, axis=0), axis=-1)
    for side in range(2):
        turns = to_rotation(pose.feet[:, side])
        rate = (turns[1:] * turns[:-1].inv()).as_rotvec()[:, 2] * fps
        fast = np.abs(np.append(rate, rate[-1])) > PIVOT
        out[fast, side, speed[fast, side].argmax(axis=1)] = True
    return out


def stop(
    equations: Equations,
    body: Figure,
    pose: Pose,
    fixed: np.ndarray,
    moves: np.ndarray,
    fps: float,
) -> None:
    """Fixed parts do not slip: their middles stay, so one part alone may turn.

    A sphere that rolls without slipping moves its centre by the turn times its radius.
    """
    centres = body.sole_centres(pose.ankles, pose.feet)
    lift = np.array([0.0, 0.0, body.radius])
    rolling = _lever_matrix(lift)
    rolling[:, :3] = 0.0
    for side in range(2):
        turns = to_rotation(pose.feet[:, side])
        rolled = np.cross((turns[1:] * turns[:-1].inv()).as_rotvec(), lift)
        for part, points in enumerate((HEEL, TOE)):
            on = fixed[:, side, part]
            frames = np.flatnonzero(on[1:] & on[:-1])
            middle = centres[:, side, points].mean(axis=1)
            lever = moves[:, side, points].mean(axis=1)
            slip = middle[frames + 1] - middle[frames] - rolled[frames]
            sides = [rolling - lever[frames], lever[frames + 1] - rolling]
            values = SLIP * fps * np.concatenate(sides, axis=2)
            columns = [_foot_columns(frames + late, side) for late in (0, 1)]
            columns = np.concatenate(columns, axis=1)
            for axis in range(2):
                wanted = -SLIP * fps * slip[:, axis]
                equations.add(columns, values[:, axis], wanted)


def keep_length(
    equations: Equations,
    frames: int,
    excess: np.ndarray,
    along: np.ndarray,
    taut: np.ndarray,
) -> None:
    """Legs are never longer than they are."""
    for side in range(2):
        on = np.flatnonzero(taut[:, side])
        columns, values = _leg_columns(np.arange(frames), side, along)
        wanted = -TOO_FAR * excess[on, side]
        equations.add(columns[on], TOO_FAR * values[on], wanted)


def _leg_columns(
    frames: np.ndarray, side: int, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns [N, 6] that change the distance from hip to ankle, and by how much."""
    root = frames[:, None] * UNKNOWNS + np.arange(UNKNOWNS)[ROOT]
    columns = np.concatenate([root, _foot_columns(frames, side)[:, :3]], axis=1)
    return columns, np.concatenate([-along[:, side], along[:, side]], axis=1)


def keep_knees(
    equations: Equations,
    body: Figure,
    start: Pose,
    pose: Pose,
    along: np.ndarray,
    fps: float,
) -> None:
    """Knees bend as they did, and above all as smoothly.

    By the law of cosines the flexion changes by -L / (a b sin) a metre of distance L
    from hip to ankle, a and b being thigh and shin: near the straight leg a millimetre
    is a degree, which is how a knee comes to pop.
    """
    upper, lower = body.leg
    before, now = _flexion(body, start), _flexion(body, pose)
    distance = np.linalg.norm(pose.ankles - pose.hips, axis=-1)
    gain = -distance / (upper * lower * np.maximum(np.sin(now), LEAST_SINE))
    change = now - before
    frames = np.arange(len(now))
    smooth = KNEE * (KNEE_EASE * fps) ** 2
    for side in range(2):
        columns, values = _leg_columns(frames, side, along)
        values = values * gain[:, side, None]
        equations.add(columns, KNEE * values, -KNEE * change[:, side])
        if len(frames) < 3:
            continue
        parts = [(0, 1.0), (1, -2.0), (2, 1.0)]
        last = len(frames) - 2
        three = [columns[at : at + last] for at, _ in parts]
        bends = [smooth * factor * values[at : at + last] for at, factor in parts]
        bend = np.diff(change[:, side], 2)
        equations.add(
            np.concatenate(three, axis=1), np.concatenate(bends, axis=1), -smooth * bend
        )


def _flexion(body: Figure, pose: Pose) -> np.ndarray:
    """Flexion [T, 2] of the knees in rad for the distance from hip to ankle."""
    upper, lower = body.leg
    distance = np.linalg.norm(pose.ankles - pose.hips, axis=-1)
    cosine = (distance**2 - upper**2 - lower**2) / (2.0 * upper * lower)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
