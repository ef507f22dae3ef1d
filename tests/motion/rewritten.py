"""Clips of the package as BVH files of other people's programs.

`Rig` says how a program writes: names, axes, unit, zero pose. What comes out of an
import of its file has to be the clip again, so every angle and the path are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.character import asset_path
from dcc_jax.motion.clip import Clip, load_clip
from dcc_jax.motion.frames import to_rotation
from dcc_jax.motion.retarget.figure import SEGMENTS, figure, world_of
from dcc_jax.motion.retarget.importer import Options, import_motion
from dcc_jax.motion.retarget.retarget import Retargeted, placed

Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # rows: x, y, z
Z_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
X_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Joint:
    """A joint of a rig; `turns` names the segment of ours whose rotation it has."""

    name: str
    parent: str
    offset: tuple[float, float, float]  # m, our axes, T-pose
    turns: str
    frame: Rotation = field(default_factory=Rotation.identity)  # of its own axes


def joints() -> list[Joint]:
    """A rig with three spine joints, collars, hands and toes, in our proportions."""
    body = dict(zip(SEGMENTS, figure().offsets, strict=True))
    neck = body["head"][2] * 0.8
    rows = [
        ("Hips", "", (0.0, 0.0, 0.0), "pelvis"),
        ("Spine", "Hips", (0.0, 0.0, body["chest"][2] * 0.5), "pelvis"),
        ("Spine1", "Spine", (0.0, 0.0, body["chest"][2] * 0.25), "pelvis"),
        ("Spine2", "Spine1", (0.0, 0.0, body["chest"][2] * 0.25), "chest"),
        ("Neck", "Spine2", (0.0, 0.0, neck), "chest"),
        ("Head", "Neck", (0.0, 0.0, body["head"][2] - neck), "head"),
        ("HeadTop_End", "Head", (0.0, 0.0, 0.18), "head"),
    ]
    for side, out in (("Left", 1.0), ("Right", -1.0)):
        low = side.lower()
        shoulder, hip = body[f"{low}_upper_arm"], body[f"{low}_thigh"]
        upper, thigh = body[f"{low}_forearm"], body[f"{low}_shin"]
        rows += [
            (f"{side}Shoulder", "Spine2", (*(shoulder * [1, 0.3, 1]),), "chest"),
            (
                f"{side}Arm",
                f"{side}Shoulder",
                (*(shoulder * [0, 0.7, 0]),),
                f"{low}_upper_arm",
            ),
            (f"{side}ForeArm", f"{side}Arm", (*upper,), f"{low}_forearm"),
            (f"{side}Hand", f"{side}ForeArm", (0.0, 0.24 * out, 0.0), f"{low}_forearm"),
            (f"{side}UpLeg", "Hips", (*hip,), f"{low}_thigh"),
            (f"{side}Leg", f"{side}UpLeg", (*thigh,), f"{low}_shin"),
            (f"{side}Foot", f"{side}Leg", (*body[f"{low}_foot"],), f"{low}_foot"),
            (f"{side}ToeBase", f"{side}Foot", (0.13, 0.0, -0.06), f"{low}_foot"),
            (f"{side}Toe_End", f"{side}ToeBase", (0.07, 0.0, 0.0), f"{low}_foot"),
        ]
    return [Joint(*row) for row in rows]


@dataclass(frozen=True)
class Rig:
    """How a program writes a figure."""

    joints: list[Joint] = field(default_factory=joints)
    axes: np.ndarray = field(default_factory=lambda: Y_UP)  # rows: the file's in ours
    scale: float = 100.0  # file units a metre
    order: str = "ZXY"
    prefix: str = ""
    placed: frozenset[str] = frozenset(("Hips",))  # joints with position channels

    def posed(self, frames: Mapping[str, Rotation]) -> Rig:
        """The rig with other axes of its joints: they make its zero pose.

        Args:
            frames: by joint; what hangs on one has the same, unless it is named.
        """
        made: dict[str, Joint] = {}
        for joint in self.joints:
            above = made[joint.parent].frame if joint.parent else Rotation.identity()
            made[joint.name] = replace(joint, frame=frames.get(joint.name, above))
        return replace(self, joints=list(made.values()))

    def renamed(self, names: Mapping[str, str]) -> Rig:
        """The rig with other names for some joints."""
        changed = [
            replace(
                joint,
                name=names.get(joint.name, joint.name),
                parent=names.get(joint.parent, joint.parent),
            )
            for joint in self.joints
        ]
        placed = frozenset(names.get(name, name) for name in self.placed)
        return replace(self, joints=changed, placed=placed)

    def text(self, clip: Clip) -> str:
        """The clip as the program writes it."""
        world = {
            name: to_rotation(turn)
            for name, turn in zip(
                SEGMENTS, np.moveaxis(world_of(clip.qpos), 1, 0), strict=True
            )
        }
        lines, order = ["HIERARCHY"], []
        change = Rotation.from_matrix(self.axes)
        by_name = {joint.name: joint for joint in self.joints}

        def write(joint: Joint, depth: int) -> None:
            pad = "\t" * depth
            parent = by_name.get(joint.parent)
            turned = parent.frame.inv().apply(joint.offset) if parent else joint.offset
            offset = self.scale * self.axes @ turned
            lines.append(
                f"{pad}{'JOINT' if parent else 'ROOT'} {self.prefix}{joint.name}"
            )
            lines.append(
                pad + "{\n" + pad + "\tOFFSET {:.6f} {:.6f} {:.6f}".format(*offset)
            )
            places = "Xposition Yposition Zposition " * (joint.name in self.placed)
            turns = " ".join(f"{axis}rotation" for axis in self.order)
            lines.append(f"{pad}\tCHANNELS {6 if places else 3} {places}{turns}")
            order.append(joint)
            children = [one for one in self.joints if one.parent == joint.name]
            for child in children:
                write(child, depth + 1)
            if not children:
                lines.append(
                    f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\tOFFSET 0 0 0\n{pad}\t}}"
                )
            lines.append(pad + "}")

        for joint in self.joints:
            if not joint.parent:
                write(joint, 0)
        columns = []
        for joint in order:
            above = by_name.get(joint.parent)
            turn = world[joint.turns] * joint.frame if joint.turns else None
            own = turn if turn is not None else Rotation.identity(len(clip.qpos))
            if above is not None and above.turns:
                own = (world[above.turns] * above.frame).inv() * own
            if joint.name in self.placed:
                columns.append(
                    self.scale * clip.qpos[:, :3].astype(float) @ self.axes.T
                )
            local = change * own * change.inv()
            columns.append(local.as_euler(self.order, degrees=True))
        rows = np.concatenate(columns, axis=1)
        lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / clip.fps:.10f}"]
        lines += [" ".join(f"{value:.6f}" for value in row) for row in rows]
        return "\n".join(lines) + "\n"


def shipped(name: str, start: int = 0, stop: int | None = None) -> Clip:
    """Some frames of a clip of the package."""
    clip = load_clip(asset_path(f"motions/{name}.npz"))
    if start == 0 and stop is None:
        return clip
    return replace(clip, qpos=clip.qpos[start:stop], loop=False, phase=None)


def imported(folder: Path, text: str, **options) -> Retargeted:
    """The import of a file with such a text."""
    path = folder / "rewritten.bvh"
    path.write_text(text)
    return import_motion(path, Options(**options))


def far_off(ours: Clip, truth: Clip) -> tuple[np.ndarray, float]:
    """How far a clip is from another: world angles [T, 13] (deg), and joints (m).

    Both begin above the origin, facing +x.
    """
    assert len(ours.qpos) == len(truth.qpos)
    ours, truth = placed(ours), placed(truth)
    turns = [to_rotation(world_of(clip.qpos)) for clip in (ours, truth)]
    places = [
        figure().positions(clip.qpos[:, :3].astype(float), world_of(clip.qpos))
        for clip in (ours, truth)
    ]
    angles = np.degrees((turns[0].inv() * turns[1]).magnitude())
    return angles, float(np.linalg.norm(places[0] - places[1], axis=-1).max())
