"""From a foreign skeleton to ours: rotation copy, ground, feet.

Every segment of ours takes the world rotation of its source segment away from the
source's zero pose, after the constant rotation of our segment in that zero pose
(`calibrate`). The root's path is scaled by the ratio of the legs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion import clip as clips
from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import moved, to_quats, to_rotation
from dcc_jax.motion.retarget.anatomy import HINGED, Anatomy, unit
from dcc_jax.motion.retarget.axes import standing_axes, world_axes
from dcc_jax.motion.retarget.calibrate import along, calibrated
from dcc_jax.motion.retarget.cleaning import clean_feet
from dcc_jax.motion.retarget.figure import SEGMENTS, qpos_of, world_of
from dcc_jax.motion.retarget.figure import figure as our_figure
from dcc_jax.motion.retarget.ground import contacts, on_level_ground
from dcc_jax.motion.retarget.judge import judged
from dcc_jax.motion.retarget.loops import closed, looped, tiled
from dcc_jax.motion.retarget.positions import denied_by_positions, from_positions
from dcc_jax.motion.retarget.quality import Quality, measure, pose_error
from dcc_jax.motion.retarget.travel import root_stays, walked_path
from dcc_jax.motion.retarget.words import SIDES

LOW_PASS = 10.0  # Hz, for what was recorded faster than 60 Hz
WORK_FPS = (
    60.0  # frame rate for cleaning, of sources as fast, where the wanted one divides it
)
WORST_POSE = 8.0  # degrees of mean pose error; standing feet ask for less than 3
ATTEMPTS = 6  # at cleaning, each of which leaves more of the feet alone
LAP = 0.5  # s, of its neighbours that a loop is cleaned with
BONE_OFF = 8.0  # degrees, in the mean, that a bone may point away from its joints
Notes = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A clip of ours, and how it came out."""

    clip: Clip
    before: Quality  # of the mere rotation copy, on level ground
    after: Quality
    pose_error: float  # degrees, mean over segments and frames, against the source
    slope: float  # rise over run of the floor that was taken out
    notes: Notes  # what was assumed, for the user
    doubts: Notes = ()  # what is not plausible in it


def retarget(
    figure: Anatomy,
    fps: float,
    up: str | None = None,
    low_pass: float = LOW_PASS,
    clean: bool = True,
    part: slice = slice(None),
) -> Retargeted:
    """A clip of our body from a figure in its own axes and unit.

    All frames tell how its bones lie and where up is, whichever are taken.

    Args:
        figure: the source, with our joints found in it.
        fps: frame rate of the clip.
        up: the world's upward axis in the source, if the caller knows.
        low_pass: Hz; frequencies above are removed from fast recordings; 0 keeps all.
        clean: whether feet are kept from sliding and sinking.
        part: the frames to take.
    """
    motion = figure.motion
    root, world, notes = copied(figure, up)
    qpos = qpos_of(root[part], world[part])
    raw = Clip(qpos, motion.fps, Path(motion.path).stem, Path(motion.path).name)
    notes = (*motion.notes, *notes)
    if motion.loop and len(qpos) == len(root):
        raw, note = looped(raw)
        notes = (*notes, note) if note else notes
    if low_pass and raw.fps > WORK_FPS and len(raw.qpos) > 8:
        raw = clips.low_pass(raw, min(low_pass, 0.45 * raw.fps))
    work = clips.resample(raw, fps * max(1, round(min(WORK_FPS, raw.fps) / fps)))
    level, slope = on_level_ground(work)
    if slope:
        notes = (*notes, f"took out a slope of {100.0 * slope:.1f} %")
    result = finish(level, fps, clean)
    return replace(
        result,
        slope=slope,
        notes=(*notes, *result.notes),
        doubts=bones_off(figure, world),
    )


def finish(level: Clip, fps: float, clean: bool) -> Retargeted:
    """Cleans a clip on level ground, measures it before and after, and places it."""
    wide, middle = _with_laps(level)
    standing = contacts(wide)
    cleaned, notes = cleaned_where_better(wide, standing) if clean else (wide, ())
    result = replace(level, qpos=cleaned.qpos[middle])
    if level.loop:
        result = replace(result, qpos=closed(result.qpos))
    error = pose_error(result, world_of(level.qpos))
    stances = _thinned(standing[middle], level, fps)
    before = measure(clips.resample(level, fps), stances)
    result = clips.resample(result, fps)
    after = measure(result, stances)
    return Retargeted(placed(result), before, after, error, 0.0, notes)


def _with_laps(level: Clip) -> tuple[Clip, slice]:
    """A loop with some of its neighbours on both sides, and where it is in that."""
    if not level.loop:
        return level, slice(0, len(level.qpos))
    laps = math.ceil(LAP / level.duration)
    start = laps * (len(level.qpos) - 1)
    return tiled(level, laps), slice(start, start + len(level.qpos))


def cleaned_where_better(clip: Clip, standing: np.ndarray) -> tuple[Clip, Notes]:
    """The clip with clean feet, except where that makes another thing worse.

    Args:
        clip: on level ground.
        standing: contacts [T, 2, 2].

    Returns:
        The clip, and a note about the feet that were left as they are.
    """
    left = np.zeros(standing.shape[:2], int)
    told: list[str] = []
    for _ in range(ATTEMPTS):
        cleaned = clean_feet(clip, standing, left)
        verdict = judged(clip, cleaned)
        if verdict.fine:
            break
        left = np.minimum(left + verdict.around(), 2)
        told.append(verdict.reasons())
    else:
        return clip, (f"feet left as they are: cleaning {told[-1]}",)
    if pose_error(cleaned, world_of(clip.qpos)) > WORST_POSE:
        return clip, ("feet left as they are: cleaning makes another pose of it",)
    if not told:
        return cleaned, ()
    share = 100.0 * (left > 0).any(axis=1).mean()
    return cleaned, (
        f"feet left as they are in {share:.0f} % of the frames: cleaning {told[0]}",
    )


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


def bones_off(figure: Anatomy, world: np.ndarray) -> Notes:
    """Limbs that do not point where the joints of the source are.

    Args:
        figure: the source.
        world: our world rotations [T, 13, 4].
    """
    limbs = [f"{side}_{part}" for side in SIDES for part in HINGED]
    theirs = np.stack([unit(figure.bone(limb)) for limb in limbs], axis=1)
    ours = np.stack(
        [to_rotation(world[:, SEGMENTS.index(s)]).apply(along(s)) for s in limbs],
        axis=1,
    )
    frames = slice(None, None, max(1, len(ours) // 500))
    turn = Rotation.align_vectors(
        ours[frames].reshape(-1, 3), theirs[frames].reshape(-1, 3)
    )[0]
    turned = turn.apply(theirs.reshape(-1, 3)).reshape(theirs.shape)
    cosine = np.clip((turned * ours).sum(-1), -1.0, 1.0)
    off = np.where(theirs.any(axis=-1), np.degrees(np.arccos(cosine)), 0.0).mean(axis=0)
    return tuple(
        f"{limb} points {angle:.0f} degrees off its joints"
        for limb, angle in zip(limbs, off, strict=True)
        if angle > BONE_OFF
    )


def copied(
    figure: Anatomy, up: str | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Our root's path [T, 3] and world rotations [T, 13, 4], and what was assumed.

    Args:
        figure: the source.
        up: the world's upward axis in it, if the caller knows.
    """
    rest_axes = standing_axes(figure.rest)
    axes, notes = world_axes(figure, rest_axes, up)
    frames, more = calibrated(figure, rest_axes, axes[2])
    theirs = {
        segment: figure.turns[segment] * Rotation.from_matrix(matrix)
        for segment, matrix in frames.items()
    }
    trunk, limbs = denied_by_positions(figure)
    if trunk or limbs:
        theirs = from_positions(figure, theirs, rest_axes, trunk, limbs)
        which = "the trunk" if trunk else ", ".join(limbs)
        more += (f"rotations and positions disagree in {which}: positions were taken",)
    turn = Rotation.from_matrix(axes)
    world = np.stack([to_quats(turn * theirs[name]) for name in SEGMENTS], axis=1)
    notes = (*notes, *more)
    if root_stays(figure.places["pelvis"], figure.leg_length):
        note = "the file says nothing of where the figure goes: its standing foot stays"
        return walked_path(world), world, (*notes, note)
    body = our_figure()
    ratio = sum(body.leg) / figure.leg_length
    hips = ratio * turn.apply(figure.middle("thigh"))
    own = body.offsets[[SEGMENTS.index(f"{s}_thigh") for s in ("left", "right")]]
    return hips - to_rotation(world[:, 0]).apply(own.mean(axis=0)), world, notes
