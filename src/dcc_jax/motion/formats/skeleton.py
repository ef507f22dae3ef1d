"""Motion on the skeleton it was recorded with, and the change to our axes and units.

Letters: T frames, J nodes (joints and end points). A node's rotation is its world
rotation *away from the zero pose*: the pose with every rotation the identity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.npz import MotionError

CMU_UNIT = 0.0254 / 0.45  # m; the CMU FAQ: inches, scaled by 0.45
UNITS = {
    "m": 1.0,
    "dm": 0.1,
    "cm": 0.01,
    "mm": 0.001,
    "inch": 0.0254,
    "foot": 0.3048,
    "cmu": CMU_UNIT,
}
GUESSED_UNITS = ("m", "cm", "mm", "inch", "cmu")
LEG_LENGTH = (0.55, 1.15)  # m, thigh and shin of a person
AXES = ("x", "y", "z", "-x", "-y", "-z")
MAX_NODES = 1000


@dataclass(frozen=True, eq=False)
class Motion:
    """What an importer reads: a tree of nodes, and where they go."""

    path: str
    names: tuple[str, ...]  # J, unique, parents before children
    parents: tuple[int, ...]  # J, -1 for the root, which comes first
    offsets: np.ndarray  # [J, 3] from the parent in the zero pose, the root's is 0
    root: np.ndarray  # [T, 3] position of the root
    quats: np.ndarray  # [T, J, 4] world rotation away from the zero pose
    fps: float
    unit: float | None = None  # m, of offsets and root; None where the file is silent
    up: str | None = None  # the axis that points up, where the format fixes it
    loop: bool = False
    roles: Mapping[str, str] = field(default_factory=dict)  # our body: node, if known
    notes: tuple[str, ...] = ()  # what was assumed, for the user

    def positions(self) -> np.ndarray:
        """World positions [T, J, 3] of all nodes, in the motion's own axes and unit."""
        out = np.empty((len(self.root), len(self.names), 3))
        for node, parent in enumerate(self.parents):
            if parent < 0:
                out[:, node] = self.root
            else:
                turn = Rotation.from_quat(self.quats[:, parent], scalar_first=True)
                out[:, node] = out[:, parent] + turn.apply(self.offsets[node])
        return out

    def rest(self) -> np.ndarray:
        """Positions [J, 3] in the zero pose, the root at the origin."""
        out = np.zeros((len(self.names), 3))
        for node, parent in enumerate(self.parents):
            if parent >= 0:
                out[node] = out[parent] + self.offsets[node]
        return out

    def ancestors(self, node: int) -> list[int]:
        """The nodes from `node` up to the root, both included."""
        chain = []
        while node >= 0:
            chain.append(node)
            node = self.parents[node]
        return chain

    def part(self, frames: slice | np.ndarray) -> Motion:
        """The motion in some of its frames."""
        return replace(self, root=self.root[frames], quats=self.quats[frames])


def world_rotations(parents: tuple[int, ...], local: list[Rotation]) -> np.ndarray:
    """World rotations [T, J, 4] of J local rotations, one array [T] a node."""
    world: list[Rotation] = []
    for parent, turn in zip(parents, local, strict=True):
        world.append(turn if parent < 0 else world[parent] * turn)
    return np.stack([turn.as_quat(scalar_first=True) for turn in world], axis=1)


def demand_finite(motion: Motion) -> Motion:
    """The motion, if all its numbers are finite and of a credible size.

    Raises:
        MotionError: otherwise.
    """
    parts = (motion.offsets, motion.root, motion.quats)
    if not all((np.abs(part) < 1e9).all() for part in parts):
        raise MotionError(motion.path, "holds a number that is not finite, or absurd")
    if not (math.isfinite(motion.fps) and 1.0 <= motion.fps <= 10_000.0):
        raise MotionError(motion.path, f"the frame rate {motion.fps} is not credible")
    return motion


def rest_on_frame(motion: Motion, frame: int) -> Motion:
    """The same motion told from the pose of one of its frames as the zero pose.

    Raises:
        MotionError: there is no such frame.
    """
    if not 0 <= frame < len(motion.root):
        raise MotionError(
            motion.path, f"no frame {frame} to rest on, it has {len(motion.root)}"
        )
    pose = Rotation.from_quat(motion.quats[frame], scalar_first=True)
    parents = np.maximum(motion.parents, 0)
    at_parent = Rotation.from_quat(motion.quats[frame, parents], scalar_first=True)
    quats = Rotation.from_quat(motion.quats, scalar_first=True) * pose.inv()
    return replace(
        motion,
        offsets=at_parent.apply(motion.offsets),
        quats=quats.as_quat(scalar_first=True),
    )


def leg_length(motion: Motion, bodies: Mapping[str, int]) -> float:
    """Thigh and shin in the motion's unit, the mean of both sides."""
    rest = motion.rest()
    chains = [
        [rest[bodies[f"{side}_{part}"]] for part in ("thigh", "shin", "foot")]
        for side in ("left", "right")
    ]
    bones = [np.linalg.norm(np.diff(chain, axis=0), axis=1).sum() for chain in chains]
    return float(np.mean(bones))


def in_metres(motion: Motion, bodies: Mapping[str, int], unit: str | None) -> Motion:
    """The motion in metres.

    Args:
        motion: as read.
        bodies: node of each body of ours.
        unit: the name of the unit; None takes what the file says, or the one that
            gives a person's legs.

    Raises:
        MotionError: no unit gives a person's legs.
    """
    length = leg_length(motion, bodies)
    notes = motion.notes
    if unit is not None:
        scale = UNITS[unit]
    elif motion.unit is not None:
        scale = motion.unit
    else:
        fits = [u for u in GUESSED_UNITS if _is_leg(length * UNITS[u])]
        if not fits:
            raise MotionError(
                motion.path,
                f"legs of {length:.4g} fit no unit of {', '.join(GUESSED_UNITS)}; "
                "say which with --unit",
            )
        scale = UNITS[fits[0]]
        notes = (*notes, f"unit taken as {fits[0]}: legs of {length * scale:.2f} m")
    if not _is_leg(length * scale):
        notes = (*notes, f"legs of {length * scale:.3g} m: is the unit right?")
    if not length * scale > 1e-6:
        raise MotionError(motion.path, "the legs have no length")
    return replace(
        motion,
        offsets=motion.offsets * scale,
        root=motion.root * scale,
        unit=1.0,
        notes=notes,
    )


def _is_leg(length: float) -> bool:
    return LEG_LENGTH[0] <= length <= LEG_LENGTH[1]


def in_our_axes(motion: Motion, bodies: Mapping[str, int], up: str | None) -> Motion:
    """The motion with x forward, y left and z up.

    The zero pose tells which way the figure stands and faces in it. The world's up is
    the same axis, unless the trunk then points elsewhere most of the time.

    Args:
        motion: as read.
        bodies: node of each body of ours.
        up: the world's upward axis, overriding the guess.

    Raises:
        MotionError: the zero pose is not that of a standing figure.
    """
    rest_axes = _standing_axes(motion, bodies)
    world_axes, notes = _world_axes(motion, bodies, rest_axes, up)
    quats = Rotation.from_matrix(world_axes) * Rotation.from_quat(
        motion.quats, scalar_first=True
    )
    quats = quats * Rotation.from_matrix(rest_axes).inv()
    return replace(
        motion,
        offsets=motion.offsets @ rest_axes.T,
        root=motion.root @ world_axes.T,
        quats=quats.as_quat(scalar_first=True),
        up="z",
        notes=(*motion.notes, *notes),
    )


def _standing_axes(motion: Motion, bodies: Mapping[str, int]) -> np.ndarray:
    """Rows: forward, left and up of the figure in its zero pose."""
    rest = motion.rest()

    def mean(part: str) -> np.ndarray:
        return 0.5 * (rest[bodies[f"left_{part}"]] + rest[bodies[f"right_{part}"]])

    legs = _unit(mean("thigh") - mean("foot"))
    trunk = _unit(mean("upper_arm") - mean("thigh"))
    across = rest[bodies["left_thigh"]] - rest[bodies["right_thigh"]]
    if np.linalg.norm(across) < 1e-9:
        across = rest[bodies["left_upper_arm"]] - rest[bodies["right_upper_arm"]]
    up = _nearest_axis(legs)
    left = _unit(across - up * (across @ up))
    if legs @ trunk < 0.7 or legs @ up < 0.9 or not left.any():
        raise MotionError(
            motion.path,
            "the zero pose does not stand upright; name a frame that does "
            "with --rest-frame",
        )
    if left @ _nearest_axis(left) > math.cos(math.radians(20.0)):
        left = _nearest_axis(left)
    return np.stack([np.cross(left, up), left, up])


def _world_axes(
    motion: Motion, bodies: Mapping[str, int], rest_axes: np.ndarray, up: str | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Rows of the world's axes, and what to tell the user about them."""
    pelvis, chest = (
        Rotation.from_quat(motion.quats[:, bodies[name]], scalar_first=True)
        for name in ("pelvis", "chest")
    )
    trunk = pelvis.apply(rest_axes[2]).mean(0) + chest.apply(rest_axes[2]).mean(0)
    if up is not None:
        upward = np.eye(3)[AXES.index(up) % 3] * (1.0 if AXES.index(up) < 3 else -1.0)
    elif motion.up is not None or trunk @ rest_axes[2] > 0.5 * np.linalg.norm(trunk):
        return rest_axes, ()
    else:
        upward = _nearest_axis(trunk)
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [rest_axes @ upward])[0]
    world = turn.as_matrix() @ rest_axes
    if np.allclose(world, rest_axes):
        return rest_axes, ()
    axis = AXES[int(np.argmax(np.concatenate([upward, -upward])))]
    return world, (f"the world's up is {axis}, unlike the zero pose's",)


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v)
    return v / length if length > 1e-9 else np.zeros(3)


def _nearest_axis(v: np.ndarray) -> np.ndarray:
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(v)))
    axis[largest] = math.copysign(1.0, v[largest])
    return axis
