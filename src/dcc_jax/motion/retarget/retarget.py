"""From a foreign skeleton to ours: rotation copy, ground, feet.

Every segment of ours takes the world rotation of its source segment away from the
source's zero pose, after a constant correction that turns our zero pose (a T-pose with
vertical legs) into the source's. The root's path is scaled by the ratio of the legs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion import clip as clips
from dcc_jax.motion.clip import Clip
from dcc_jax.motion.formats.skeleton import Motion, leg_length
from dcc_jax.motion.frames import moved, to_quats, to_rotation
from dcc_jax.motion.retarget.cleaning import clean_feet
from dcc_jax.motion.retarget.figure import SEGMENTS, figure, qpos_of, world_of
from dcc_jax.motion.retarget.ground import contacts, on_level_ground
from dcc_jax.motion.retarget.loops import closed, looped, tiled
from dcc_jax.motion.retarget.quality import Quality, measure, pose_error

LOW_PASS = 10.0  # Hz, for what was recorded faster than 60 Hz
WORK_FPS = 60.0  # frame rate for cleaning, where the wanted one divides it
OWN_DIRECTION = math.radians(10.0)  # a bone off its limb by more is aligned by itself
WORST_POSE = 8.0  # degrees of mean pose error; standing feet ask for less than 3
SPREAD = math.radians(12.0)  # legs spread further have feet square to them


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A clip of ours, and how it came out."""

    clip: Clip
    before: Quality  # of the mere rotation copy, on level ground
    after: Quality
    pose_error: float  # degrees, mean over segments and frames, against the source
    slope: float  # rise over run of the floor that was taken out
    notes: tuple[str, ...]  # what was assumed, for the user


def retarget(
    motion: Motion,
    bodies: Mapping[str, int],
    fps: float,
    low_pass: float = LOW_PASS,
    clean: bool = True,
) -> Retargeted:
    """A clip of our body from a motion in our axes and in metres.

    Args:
        motion: the source.
        bodies: node of each of our bodies.
        fps: frame rate of the clip.
        low_pass: Hz; frequencies above are removed from fast recordings; 0 keeps all.
        clean: whether feet are kept from sliding and sinking.
    """
    root, world = copied(motion, bodies)
    name = Path(motion.path).stem
    raw = Clip(qpos_of(root, world), motion.fps, name, Path(motion.path).name)
    notes = motion.notes
    if motion.loop:
        raw, note = looped(raw)
        notes = (*notes, note) if note else notes
    if low_pass and raw.fps > WORK_FPS and len(raw.qpos) > 8:
        raw = clips.low_pass(raw, min(low_pass, 0.45 * raw.fps))
    work = clips.resample(raw, fps * max(1, round(WORK_FPS / fps)))
    level, slope = on_level_ground(work)
    if slope:
        notes = (*notes, f"took out a slope of {100.0 * slope:.1f} %")
    result = finish(level, fps, clean)
    return replace(result, slope=slope, notes=(*notes, *result.notes))


def finish(level: Clip, fps: float, clean: bool) -> Retargeted:
    """Cleans a clip on level ground, measures it before and after, and places it."""
    laps = 1 + math.ceil(0.5 / level.duration) if level.loop else 0
    wide = tiled(level, laps)
    standing = contacts(wide)
    cleaned = clean_feet(wide, standing) if clean else wide
    start = laps * (len(level.qpos) - 1)
    middle = slice(start, start + len(level.qpos))
    result = replace(level, qpos=cleaned.qpos[middle])
    if level.loop:
        result = replace(result, qpos=closed(result.qpos))
    error = pose_error(result, world_of(level.qpos))
    notes: tuple[str, ...] = ()
    if error > WORST_POSE:
        notes = (
            f"feet left as they are: cleaning would turn limbs by {error:.0f} deg",
        )
        result, error = level, 0.0
    stances = _thinned(standing[middle], level, fps)
    before = measure(clips.resample(level, fps), stances)
    result = clips.resample(result, fps)
    after = measure(result, stances)
    return Retargeted(placed(result), before, after, error, 0.0, notes)


def _thinned(standing: np.ndarray, clip: Clip, fps: float) -> np.ndarray:
    """Contacts at the frames that resampling to `fps` keeps."""
    frames = len(clips.resample(clip, fps).qpos)
    at = np.round(np.arange(frames) * (len(standing) - 1) / max(frames - 1, 1))
    if not clip.loop:
        at = np.round(np.arange(frames) * clip.fps / fps)
    return standing[np.minimum(at.astype(int), len(standing) - 1)]


def placed(clip: Clip) -> Clip:
    """The clip moved so that it starts above the origin, facing +x."""
    forward = to_rotation(clip.qpos[0, 3:7]).apply([1.0, 0.0, 0.0])
    turn = -math.atan2(forward[1], forward[0]) if np.hypot(*forward[:2]) > 0.1 else 0.0
    turned = moved(clip.qpos, turn, np.zeros(3))
    turned[:, :2] -= turned[0, :2]
    position, quats = clips.split_qpos(turned)
    return replace(clip, qpos=clips.join_qpos(position, quats))


def copied(motion: Motion, bodies: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Our root's path [T, 3] and world rotations [T, 13, 4] by rotation copy."""
    body = figure()
    nodes = [bodies[name] for name in SEGMENTS]
    away = to_rotation(motion.quats[:, nodes])
    world = to_quats(away * corrections(motion, bodies))
    ratio = sum(body.leg) / leg_length(motion, bodies)
    positions = motion.positions()
    hips = positions[:, [bodies["left_thigh"], bodies["right_thigh"]]].mean(axis=1)
    own = body.offsets[[SEGMENTS.index(f"{s}_thigh") for s in ("left", "right")]]
    return ratio * hips - to_rotation(world[:, 0]).apply(own.mean(axis=0)), world


def corrections(motion: Motion, bodies: Mapping[str, int]) -> Rotation:
    """Constant rotations [13] from our zero pose to the source's, by segment."""
    turns = {name: Rotation.identity() for name in SEGMENTS}
    rest = motion.rest()
    for side, out in (("left", 1.0), ("right", -1.0)):
        leg = [rest[bodies[f"{side}_{part}"]] for part in ("thigh", "shin", "foot")]
        thigh, shin = _limb_turns(np.array([0.0, 0.0, -1.0]), leg)
        turns[f"{side}_thigh"], turns[f"{side}_shin"] = thigh, shin
        if thigh.magnitude() > SPREAD:
            turns[f"{side}_foot"] = shin
        hand = bodies.get(f"{side}_hand")
        arm = [rest[bodies[f"{side}_{part}"]] for part in ("upper_arm", "forearm")]
        arm += [rest[hand]] if hand is not None else []
        upper, lower = _limb_turns(np.array([0.0, out, 0.0]), arm)
        turns[f"{side}_upper_arm"], turns[f"{side}_forearm"] = upper, lower
    return Rotation.concatenate([turns[name] for name in SEGMENTS])


def _limb_turns(ours: np.ndarray, joints: list[np.ndarray]) -> list[Rotation]:
    """Turns of both bones of a limb from our direction to the source's.

    A bone takes the direction of the whole limb, so that a joint centre a little off
    the line bends nothing, unless its own differs by more than `OWN_DIRECTION`.
    """
    whole = _turn(ours, joints[-1] - joints[0])
    turns = []
    for begin, end in zip(joints[:2], [*joints[1:], joints[-1]][:2], strict=True):
        own = _turn(ours, end - begin) if np.linalg.norm(end - begin) > 1e-6 else whole
        apart = (whole.inv() * own).magnitude()
        turns.append(own if apart > OWN_DIRECTION else whole)
    return turns


def _turn(ours: np.ndarray, theirs: np.ndarray) -> Rotation:
    """The shortest rotation from one direction to another."""
    theirs = theirs / max(float(np.linalg.norm(theirs)), 1e-12)
    axis = np.cross(ours, theirs)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return Rotation.identity()
    return Rotation.from_rotvec(axis / sine * math.atan2(sine, float(ours @ theirs)))
