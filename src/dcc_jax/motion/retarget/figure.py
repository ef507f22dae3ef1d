"""Our body as offline motion code sees it: segments, lengths and soles, vectorized.

Letters: T frames; 13 segments, one for each rotation of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np

from dcc_jax.character import asset_path
from dcc_jax.motion.frames import join_qpos, split_qpos, to_quats, to_rotation

SEGMENTS = (
    "pelvis",
    "chest",
    "head",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    "left_thigh",
    "left_shin",
    "left_foot",
    "right_thigh",
    "right_shin",
    "right_foot",
)
PARENTS = (-1, 0, 1, 1, 3, 1, 5, 0, 7, 8, 0, 10, 11)
FEET = (9, 12)  # segments, left first
SHINS, THIGHS = (8, 11), (7, 10)
HEEL, TOE = slice(0, 2), slice(2, 4)  # of the four spheres of a sole


@dataclass(frozen=True, eq=False)
class Figure:
    """Lengths of the body, from the character's model."""

    offsets: np.ndarray  # [13, 3] m, each joint in its parent segment's frame
    soles: np.ndarray  # [2, 4, 3] m, sphere centres in the foot: heel, heel, toe, toe
    radius: float  # m, of the spheres

    @property
    def leg(self) -> tuple[float, float]:
        """Lengths of thigh and shin, m."""
        shin, foot = (float(np.linalg.norm(self.offsets[k])) for k in (8, 9))
        return shin, foot

    def positions(self, root: np.ndarray, world: np.ndarray) -> np.ndarray:
        """Positions [T, 13, 3] of the joints.

        Args:
            root: [T, 3] m.
            world: world rotations [T, 13, 4] of the segments.
        """
        matrices = to_rotation(world).as_matrix()
        out = np.empty((len(root), len(PARENTS), 3))
        for k, parent in enumerate(PARENTS):
            out[:, k] = root
            if parent >= 0:
                out[:, k] = out[:, parent] + matrices[:, parent] @ self.offsets[k]
        return out

    def sole_centres(self, ankles: np.ndarray, feet: np.ndarray) -> np.ndarray:
        """Centres [T, 2, 4, 3] of the sole spheres.

        Args:
            ankles: [T, 2, 3] m.
            feet: world rotations [T, 2, 4].
        """
        return ankles[:, :, None] + np.einsum(
            "tfij,fkj->tfki", to_rotation(feet).as_matrix(), self.soles
        )


@cache
def figure() -> Figure:
    """The standard character's figure."""
    model = mujoco.MjModel.from_xml_path(str(asset_path("character.xml")))
    offsets = np.array([model.body(name).pos for name in SEGMENTS])
    offsets[0] = 0.0
    kinds = ("heel_in", "heel_out", "toe_in", "toe_out")
    soles = [
        [model.geom(f"{side}_sole_{kind}") for kind in kinds]
        for side in ("left", "right")
    ]
    return Figure(
        offsets=offsets,
        soles=np.array([[geom.pos for geom in foot] for foot in soles]),
        radius=float(soles[0][0].size[0]),
    )


def world_of(qpos: np.ndarray) -> np.ndarray:
    """World rotations [T, 13, 4] of the segments."""
    local = split_qpos(qpos)[1].astype(float)
    world = np.empty_like(local)
    for k, parent in enumerate(PARENTS):
        turn = to_rotation(local[:, k])
        world[:, k] = to_quats(
            turn if parent < 0 else to_rotation(world[:, parent]) * turn
        )
    return world


def qpos_of(root: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Frames [T, 55] of a root path [T, 3] and world rotations [T, 13, 4]."""
    above = to_rotation(world[:, list(PARENTS[1:])])
    local = to_quats(above.inv() * to_rotation(world[:, 1:]))
    return join_qpos(root, np.concatenate([world[:, :1], local], axis=1))


def soles_of(qpos: np.ndarray) -> np.ndarray:
    """Centres [T, 2, 4, 3] of the sole spheres of frames [T, 55]."""
    body, world = figure(), world_of(qpos)
    positions = body.positions(qpos[:, :3].astype(float), world)
    return body.sole_centres(positions[:, list(FEET)], world[:, list(FEET)])
