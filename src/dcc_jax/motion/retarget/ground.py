"""Where the ground is in a recording, and when the feet stand on it.

Letters: T frames. Contacts are [T, 2 feet, 2 parts], heel and toe.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import join_qpos, split_qpos, to_quats, to_rotation
from dcc_jax.motion.retarget.figure import figure, soles_of, world_of

SLOW = 0.3  # m/s, of a point that may be standing
TRUNK_RADIUS = 0.1  # m
UPRIGHT = 0.4  # m, of the pelvis above the feet of who stands, at least once
MAX_SLOPE = 0.05
MIN_SLOPE = 0.006  # below this a floor counts as level
MIN_TRAVEL = 1.0  # m, over which a slope can be told
NEXT_PLACE = 0.3  # m, between stances that count as different places
# A part touches down below the first height and speed, and leaves above the second.
HEIGHTS = (0.035, 0.05)  # m
SPEEDS = (0.35, 0.55)  # m/s
FIRM = 0.1  # m/s, of a part that stands beyond doubt
SHORTEST = 0.06  # s, of a contact, and of a gap in one
# At its ends a contact is only where the part is near its place in the middle of it: a
# heel that rises slowly over standing toes has left the ground.
RISEN = 0.008  # m
LEAVING = 0.16  # m/s ...
HURRY = 0.03  # ... and so much more for every m/s of the body above a walk's
WALK = 1.5  # m/s


def on_level_ground(clip: Clip) -> tuple[Clip, float]:
    """The clip turned and shifted so that its standing feet are at z = 0.

    Returns:
        The clip, and the slope of the floor that was taken out (rise over run).
    """
    stances = _stances(clip)
    slope, direction = _slope(stances)
    if slope:
        axis = np.array([-direction[1], direction[0], 0.0]) * math.atan(slope)
        clip = _turned(clip, Rotation.from_rotvec(axis))
        stances = _stances(clip)
    position, quats = split_qpos(clip.qpos)
    floor = float(np.median(stances[:, 2]))
    if floor > float(position[:, 2].max()) - UPRIGHT:
        floor = min(floor, _lying_floor(clip))
    level = position - [0.0, 0.0, floor]
    return replace(clip, qpos=join_qpos(level, quats)), slope


def _lying_floor(clip: Clip) -> float:
    """Height (m) of what a figure lies on that does not rest on its feet; inf else.

    It lies where the surface of its trunk is lower than its feet in most frames.
    """
    body, world = figure(), world_of(clip.qpos)
    positions = body.positions(clip.qpos[:, :3].astype(float), world)[..., 2]
    feet = soles_of(clip.qpos)[..., 2].min(axis=(1, 2)) - body.radius
    trunk = positions[:, :2].min(axis=1) - TRUNK_RADIUS
    lying = trunk < feet
    return float(np.median(trunk[lying])) if lying.mean() > 0.5 else math.inf


def _turned(clip: Clip, turn: Rotation) -> Clip:
    position, quats = split_qpos(clip.qpos)
    quats = quats.copy()
    quats[:, 0] = to_quats(turn * to_rotation(quats[:, 0]))
    return replace(clip, qpos=join_qpos(turn.apply(position), quats))


def _stances(clip: Clip) -> np.ndarray:
    """Where each foot stood, each time it did: points [N, 3], in order of time.

    A stance is a stretch in which the lowest point of the foot is slow and near the
    lowest such point; its place is the median. Where no foot ever stands it is the
    lowest point of all.
    """
    centres = soles_of(clip.qpos)
    bottoms = centres - [0.0, 0.0, figure().radius]
    speed = np.linalg.norm(np.gradient(centres, 1.0 / clip.fps, axis=0), axis=-1)
    lowest = bottoms[..., 2].argmin(axis=2)[..., None]
    slow = np.take_along_axis(speed, lowest, axis=2)[..., 0] < SLOW
    points = np.take_along_axis(bottoms, lowest[..., None], axis=2)[:, :, 0]
    if not slow.any():
        return points.reshape(-1, 3)[points[..., 2].argmin()][None]
    slow &= points[..., 2] < np.percentile(points[slow][:, 2], 10) + 0.12
    stances = []
    for foot in range(2):
        on = slow[:, foot]
        labels = np.cumsum(np.diff(on, prepend=False) & on)
        for label in np.unique(labels[on]):
            stances.append(np.median(points[on & (labels == label), foot], axis=0))
    return np.array(stances)


def _slope(stances: np.ndarray) -> tuple[float, np.ndarray]:
    """Slope of the ground along the way the feet go, and that way [2].

    The median of the slopes between all stances far apart, so that single high steps
    do not count. Zero where there are not enough: it takes four places in a row, or a
    jump would be taken for a slope.
    """
    centred = stances[:, :2] - stances[:, :2].mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = np.sort(centred @ direction)
    height = stances[np.argsort(centred @ direction), 2]
    places = 1 + np.count_nonzero(np.diff(along) > NEXT_PLACE)
    if np.ptp(along) < MIN_TRAVEL or places < 4:
        return 0.0, direction
    first, second = np.triu_indices(len(along), 1)
    run = along[second] - along[first]
    far = run > 0.5 * MIN_TRAVEL
    slope = float(np.median(((height[second] - height[first]) / run)[far]))
    return (slope if MIN_SLOPE < abs(slope) < MAX_SLOPE else 0.0), direction


def contacts(clip: Clip) -> np.ndarray:
    """Which parts of the feet stand on the ground z = 0, [T, 2, 2] boolean."""
    centres = soles_of(clip.qpos)
    parts = centres.reshape(len(centres), 2, 2, 2, 3).mean(axis=3)
    height = parts[..., 2] - figure().radius
    velocity = np.gradient(parts, 1.0 / clip.fps, axis=0)
    speed = np.linalg.norm(velocity, axis=-1)
    low = _touching_height(height, speed)
    touch = (height < low) & (speed < SPEEDS[0])
    stay = (height < low + HEIGHTS[1] - HEIGHTS[0]) & (speed < SPEEDS[1])
    shortest = max(1, round(SHORTEST * clip.fps))
    way = np.linalg.norm(np.diff(clip.qpos[:, :2].astype(float), axis=0), axis=1)
    leaving = LEAVING + HURRY * max(0.0, float(way.mean()) * clip.fps - WALK)
    out = np.zeros_like(touch)
    for foot in range(2):
        for part in range(2):
            held = _held(touch[:, foot, part], stay[:, foot, part])
            held = _without_short_runs(held, shortest)
            at = height[:, foot, part], speed[:, foot, part]
            out[:, foot, part] = _without_loose_ends(held, *at, leaving)
    return out


def _touching_height(height: np.ndarray, speed: np.ndarray) -> float:
    """Below which height (m) a slow part touches the ground.

    Where all that stands firmly is at zero, a toe that hangs in the air for a moment
    3 cm above it is not standing; in a recording whose feet are less exact it may be.
    """
    firm = height[(speed < FIRM) & (height < HEIGHTS[0])]
    spread = float(np.percentile(firm, 90)) if firm.size else HEIGHTS[0]
    return float(np.clip(spread + RISEN, 1.5 * RISEN, HEIGHTS[0]))


def _held(touch: np.ndarray, stay: np.ndarray) -> np.ndarray:
    """Stretches of `stay` that hold some `touch`, [T]."""
    labels = np.cumsum(np.diff(stay, prepend=False) & stay) * stay
    return stay & np.isin(labels, np.unique(labels[touch & stay]))


def _without_loose_ends(
    on: np.ndarray, height: np.ndarray, speed: np.ndarray, leaving: float
) -> np.ndarray:
    """The contact [T] without the frames at its ends in which the part leaves.

    Args:
        on: the contact.
        height: m, of the part.
        speed: m/s, of the part.
        leaving: m/s, above its speed in the middle, from which it leaves.
    """
    out = on.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    for start, stop in edges.reshape(-1, 2):
        run = slice(start, stop)
        place, slow = np.percentile(height[run], 30), np.percentile(speed[run], 30)
        loose = (height[run] > place + RISEN) | (speed[run] > slow + leaving)
        firm = np.flatnonzero(~loose)
        out[start : start + firm[0]] = False
        out[start + firm[-1] + 1 : stop] = False
    return out


def _without_short_runs(on: np.ndarray, shortest: int) -> np.ndarray:
    """The signal [T] with gaps, then stretches, shorter than `shortest` removed."""
    window = 2 * (shortest // 2) + 1
    return median_filter(on.astype(np.uint8), size=window, mode="nearest").astype(bool)
