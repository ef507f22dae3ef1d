"""Motion files for the tests: synthetic ones, and real ones where they are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

MOTIONS = Path(__file__).resolve().parents[3] / "shared" / "motions"

# name, parent, offset in m (x forward, y left, z up), as exporters for games name them
FIGURE = (
    ("Hips", -1, (0.0, 0.0, 0.0)),
    ("Spine", 0, (0.0, 0.0, 0.10)),
    ("Spine1", 1, (0.0, 0.0, 0.12)),
    ("Spine2", 2, (0.0, 0.0, 0.13)),
    ("Neck", 3, (0.0, 0.0, 0.15)),
    ("Head", 4, (0.02, 0.0, 0.10)),
    ("LeftShoulder", 3, (0.0, 0.06, 0.09)),
    ("LeftArm", 6, (0.0, 0.12, 0.0)),
    ("LeftForeArm", 7, (0.0, 0.28, 0.0)),
    ("LeftHand", 8, (0.0, 0.26, 0.0)),
    ("RightShoulder", 3, (0.0, -0.06, 0.09)),
    ("RightArm", 10, (0.0, -0.12, 0.0)),
    ("RightForeArm", 11, (0.0, -0.28, 0.0)),
    ("RightHand", 12, (0.0, -0.26, 0.0)),
    ("LeftUpLeg", 0, (0.0, 0.09, -0.05)),
    ("LeftLeg", 14, (0.0, 0.0, -0.44)),
    ("LeftFoot", 15, (0.0, 0.0, -0.42)),
    ("LeftToeBase", 16, (0.13, 0.0, -0.07)),
    ("RightUpLeg", 0, (0.0, -0.09, -0.05)),
    ("RightLeg", 18, (0.0, 0.0, -0.44)),
    ("RightFoot", 19, (0.0, 0.0, -0.42)),
    ("RightToeBase", 20, (0.13, 0.0, -0.07)),
)
Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # rows: x, y, z
Z_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # facing -y


def march(frames: int) -> tuple[np.ndarray, list[Rotation]]:
    """Marching ahead on the spot's sake: root path [T, 3] and local rotations."""
    t = np.arange(frames) / 30.0
    swing = np.sin(2.0 * np.pi * t)
    turns = {name: np.zeros((frames, 3)) for name, _, _ in FIGURE}
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        lift = np.maximum(sign * swing, 0.0)
        turns[f"{side}UpLeg"][:, 1] = -0.9 * lift
        turns[f"{side}Leg"][:, 1] = 1.2 * lift
        turns[f"{side}Foot"][:, 1] = -0.3 * lift
        turns[f"{side}Arm"][:, 0] = -sign * 1.2
        turns[f"{side}ForeArm"][:, 2] = -sign * 0.4
    turns["Spine1"][:, 2] = 0.1 * swing
    root = np.stack([0.02 * swing, 0.01 * swing, np.full(frames, 1.0)], axis=1)
    return root, [Rotation.from_rotvec(turns[name]) for name, _, _ in FIGURE]


def bvh(
    frames: int = 45,
    prefix: str = "mixamorig:",
    scale: float = 100.0,
    axes: np.ndarray = Y_UP,
    order: str = "ZXY",
    newline: str = "\n",
) -> str:
    """The march as BVH text.

    Args:
        frames: at 30 frames a second.
        prefix: of every joint's name.
        scale: file units a metre.
        axes: rows are the file's axes in ours.
        order: of the rotation channels.
        newline: between lines.
    """
    root, local = march(frames)
    change = Rotation.from_matrix(axes)
    lines = ["HIERARCHY"]

    def write(node: int, depth: int) -> None:
        pad = "\t" * depth
        name, parent, offset = FIGURE[node]
        x, y, z = scale * axes @ offset
        lines.append(f"{pad}{'ROOT' if parent < 0 else 'JOINT'} {prefix}{name}")
        lines.append(pad + "{")
        lines.append(f"{pad}\tOFFSET {x:.6f} {y:.6f} {z:.6f}")
        turns = " ".join(f"{axis}rotation" for axis in order)
        places = "Xposition Yposition Zposition " if parent < 0 else ""
        lines.append(f"{pad}\tCHANNELS {6 if parent < 0 else 3} {places}{turns}")
        children = [k for k, row in enumerate(FIGURE) if row[1] == node]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.append(
                f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\t\tOFFSET 0 0 0\n{pad}\t}}"
            )
        lines.append(pad + "}")

    write(0, 0)
    visited = [
        line.split(maxsplit=1)[1]
        for line in lines
        if line.split()[0] in ("ROOT", "JOINT")
    ]
    nodes = [[row[0] for row in FIGURE].index(name[len(prefix) :]) for name in visited]
    angles = [
        (change * local[node] * change.inv()).as_euler(order, degrees=True)
        for node in nodes
    ]
    lines += ["MOTION", f"Frames: {frames}", f"Frame Time: {1.0 / 30.0:.7f}"]
    places = scale * root @ axes.T
    for t in range(frames):
        row = [*places[t], *np.concatenate([angle[t] for angle in angles])]
        lines.append(" ".join(f"{value:.6f}" for value in row))
    return newline.join("\n".join(lines).split("\n")) + newline


_ASF_BONES = (
    # name, parent, direction, length in inches * 0.45, dof
    ("lhipjoint", "root", (0.5, -0.8, 0.3), 2.0, ""),
    ("lfemur", "lhipjoint", (0.34202, -0.93969, 0.0), 7.2, "rx ry rz"),
    ("ltibia", "lfemur", (0.34202, -0.93969, 0.0), 7.4, "rx"),
    ("lfoot", "ltibia", (0.0, -0.25, 0.97), 2.2, "rx rz"),
    ("ltoes", "lfoot", (0.0, 0.0, 1.0), 1.1, "rx"),
    ("rhipjoint", "root", (-0.5, -0.8, 0.3), 2.0, ""),
    ("rfemur", "rhipjoint", (-0.34202, -0.93969, 0.0), 7.2, "rx ry rz"),
    ("rtibia", "rfemur", (-0.34202, -0.93969, 0.0), 7.4, "rx"),
    ("rfoot", "rtibia", (0.0, -0.25, 0.97), 2.2, "rx rz"),
    ("lowerback", "root", (0.0, 1.0, 0.0), 2.0, "rx ry rz"),
    ("thorax", "lowerback", (0.0, 1.0, 0.0), 2.5, "rx ry rz"),
    ("head", "thorax", (0.0, 1.0, 0.0), 3.5, "rx ry rz"),
    ("lclavicle", "thorax", (1.0, 0.2, 0.0), 2.8, "ry rz"),
    ("lhumerus", "lclavicle", (1.0, 0.0, 0.0), 5.0, "rx ry rz"),
    ("lradius", "lhumerus", (1.0, 0.0, 0.0), 3.4, "rx"),
    ("lthumb", "lradius", (0.7, 0.0, 0.7), 1.0, "rx rz"),
    ("rclavicle", "thorax", (-1.0, 0.2, 0.0), 2.8, "ry rz"),
    ("rhumerus", "rclavicle", (-1.0, 0.0, 0.0), 5.0, "rx ry rz"),
    ("rradius", "rhumerus", (-1.0, 0.0, 0.0), 3.4, "rx"),
)


def asf() -> str:
    """A small skeleton in the manner of CMU's."""
    rows = [":version 1.10", ":name test", ":units", "  mass 1.0", "  length 0.45"]
    rows += ["  angle deg", ":root", "  order TX TY TZ RX RY RZ", "  axis XYZ"]
    rows += ["  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    for number, (name, _, direction, length, dof) in enumerate(_ASF_BONES, 1):
        twist = 20.0 if name[1:] in ("femur", "tibia") else 0.0
        twist = -twist if name[0] == "r" else twist
        rows += ["  begin", f"     id {number}", f"     name {name}"]
        rows.append("     direction {} {} {}".format(*direction))
        rows += [f"     length {length}", f"     axis 0 0 {twist} XYZ"]
        if dof:
            rows.append(f"     dof {dof}")
            rows += ["     limits (-160.0 20.0)"] + ["            (-70.0 70.0)"] * (
                len(dof.split()) - 1
            )
        rows.append("  end")
    rows += [":hierarchy", "  begin"]
    for parent in dict.fromkeys(bone[1] for bone in _ASF_BONES):
        children = [bone[0] for bone in _ASF_BONES if bone[1] == parent]
        rows.append(f"    {parent} {' '.join(children)}")
    return "\n".join([*rows, "  end"]) + "\n"


def amc(frames: int = 60, skip: tuple[str, ...] = ()) -> str:
    """A crouch at 120 frames a second on that skeleton, without the bones in `skip`."""
    rows = ["#!OML:ASF test", ":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(1, frames + 1):
        bend = 20.0 * (1.0 - np.cos(2.0 * np.pi * frame / frames))
        height = 2.8 + 13.72 * np.cos(np.radians(bend))
        rows += [str(frame), f"root 1.0 {height} 0.5 720.0 3.6e-015 0"]
        for name, _, _, _, dof in _ASF_BONES:
            first = {"femur": -bend, "tibia": 2.0 * bend, "foot": -bend}
            values = [first.get(name[1:], 0.0)] + [0.0] * (len(dof.split()) - 1)
            if dof and name not in skip:
                rows.append(f"{name} {' '.join(map(str, values))}")
    return "\n".join(rows) + "\n"
