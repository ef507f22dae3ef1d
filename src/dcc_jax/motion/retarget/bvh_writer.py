"""A clip as BVH, with our skeleton, for Blender, MotionBuilder and the like.

The file has y up, centimetres, a T-pose as its zero pose, and the joint names that most
programs know. Our own importer reads it back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.formats.npz import write_atomically
from dcc_jax.motion.frames import split_qpos, to_rotation
from dcc_jax.motion.retarget.figure import PARENTS, SEGMENTS, figure

SCALE = 100.0  # file units a metre
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # rows: x, y, z
ORDER = "ZXY"
NAMES = {
    "pelvis": "Hips",
    "chest": "Spine",
    "head": "Head",
    **{
        f"{side.lower()}_{part}": side + name
        for side in ("Left", "Right")
        for part, name in (
            ("upper_arm", "Arm"),
            ("forearm", "ForeArm"),
            ("thigh", "UpLeg"),
            ("shin", "Leg"),
            ("foot", "Foot"),
        )
    },
}
HAND = 0.24  # m, from elbow to wrist, where nothing turns
ENDS = {"head": (0.0, 0.0, 0.18), "foot": (0.13, 0.0, -0.06)}  # m
TIPS = {"hand": 0.08, "foot": 0.07}  # m, of what hangs on the ends


def write_bvh(path: str | Path, clip: Clip) -> None:
    """Writes a clip.

    Raises:
        MotionError: the file cannot be written.
    """
    write_atomically(path, bvh_text(clip).encode("ascii"))


def bvh_text(clip: Clip) -> str:
    """The file's text."""
    lines = ["HIERARCHY"]
    order: list[int] = []
    _write_segment(lines, order, 0, 0)
    lines += ["MOTION", f"Frames: {len(clip.qpos)}"]
    lines.append(f"Frame Time: {1.0 / clip.fps:.10f}")
    root, quats = split_qpos(clip.qpos.astype(float))
    change = Rotation.from_matrix(AXES)
    columns = [SCALE * root @ AXES.T]
    for segment in order:
        still = np.zeros((len(root), 3))
        if segment >= 0:
            turn = change * to_rotation(quats[:, segment]) * change.inv()
            still = turn.as_euler(ORDER, degrees=True)
        columns.append(still)
    rows = np.concatenate(columns, axis=1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in rows]
    return "\n".join(lines) + "\n"


def _write_segment(
    lines: list[str], order: list[int], segment: int, depth: int
) -> None:
    """A segment and all that hangs on it; its channels join the order of the rows."""
    pad = "\t" * depth
    name = SEGMENTS[segment]
    lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {NAMES[name]}")
    places = "" if depth else "Xposition Yposition Zposition "
    _open(lines, pad, figure().offsets[segment], places)
    order.append(segment)
    side, _, part = name.rpartition("_")
    for child in [k for k, parent in enumerate(PARENTS) if parent == segment]:
        _write_segment(lines, order, child, depth + 1)
    out = 1.0 if side == "left" else -1.0
    if part == "head":
        _end(lines, pad + "\t", ENDS["head"])
    elif part == "foot":
        toe = ENDS["foot"]
        _write_tip(
            lines, order, depth, f"{side.title()}ToeBase", toe, (TIPS["foot"], 0, 0)
        )
    elif part == "forearm":
        hand, tip = (0.0, out * HAND, 0.0), (0.0, out * TIPS["hand"], 0.0)
        _write_tip(lines, order, depth, f"{side.title()}Hand", hand, tip)
    lines.append(pad + "}")


def _write_tip(
    lines: list[str],
    order: list[int],
    depth: int,
    name: str,
    offset: tuple[float, ...],
    tip: tuple[float, ...],
) -> None:
    """A joint that never turns: hand and toes, which other programs look for."""
    pad = "\t" * (depth + 1)
    lines.append(f"{pad}JOINT {name}")
    _open(lines, pad, offset, "")
    order.append(-1)
    _end(lines, pad + "\t", tip)
    lines.append(pad + "}")


def _open(lines: list[str], pad: str, offset, places: str) -> None:
    turns = " ".join(f"{axis}rotation" for axis in ORDER)
    count = 6 if places else 3
    lines += [f"{pad}{{", f"{pad}\tOFFSET {_triple(offset)}"]
    lines.append(f"{pad}\tCHANNELS {count} {places}{turns}")


def _end(lines: list[str], pad: str, offset) -> None:
    lines += [
        f"{pad}End Site",
        f"{pad}{{",
        f"{pad}\tOFFSET {_triple(offset)}",
        f"{pad}}}",
    ]


def _triple(offset) -> str:
    """An offset in the file's axes and unit."""
    return " ".join(
        f"{value:.6f}" for value in SCALE * AXES @ np.asarray(offset, float)
    )
