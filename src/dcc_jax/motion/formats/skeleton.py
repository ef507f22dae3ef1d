"""Motion on the skeleton it was recorded with, in its own axes and unit.

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
    moves: Mapping[int, np.ndarray] = field(default_factory=dict)
    """Offsets [T, 3] of the nodes that shift against their parents, by node."""

    def positions(self) -> np.ndarray:
        """World positions [T, J, 3] of all nodes, in the motion's own axes and unit."""
        out = np.empty((len(self.root), len(self.names), 3))
        for node, parent in enumerate(self.parents):
            if parent < 0:
                out[:, node] = self.root
            else:
                turn = Rotation.from_quat(self.quats[:, parent], scalar_first=True)
                offset = self.moves.get(node, self.offsets[node])
                out[:, node] = out[:, parent] + turn.apply(offset)
        return out

    def turns(self, node: int) -> Rotation:
        """World rotations [T] of a node away from the zero pose."""
        return Rotation.from_quat(self.quats[:, node], scalar_first=True)

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
        return replace(
            self,
            root=self.root[frames],
            quats=self.quats[frames],
            moves={node: move[frames] for node, move in self.moves.items()},
        )

    def noted(self, *notes: str) -> Motion:
        """The motion with more to tell the user."""
        return replace(self, notes=(*self.notes, *notes))


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
    parts = (motion.offsets, motion.root, motion.quats, *motion.moves.values())
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
        moves={
            node: at_parent[node].apply(move) for node, move in motion.moves.items()
        },
    )
