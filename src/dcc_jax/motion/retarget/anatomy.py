"""Where the joints of a foreign figure are, and what turns its segments.

Letters: T frames. Everything is in the axes of the source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.retarget.words import SIDES

# The joint at the lower end of a segment.
ENDS = {
    f"{side}_{part}": f"{side}_{end}"
    for side in SIDES
    for part, end in (
        ("thigh", "shin"),
        ("shin", "foot"),
        ("foot", "toe"),
        ("upper_arm", "forearm"),
        ("forearm", "hand"),
    )
}
HINGED = ("thigh", "shin", "upper_arm", "forearm")


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A foreign figure with the joints of our body found in it."""

    motion: Motion
    bodies: Mapping[str, int]

    @cached_property
    def places(self) -> dict[str, np.ndarray]:
        """Positions [T, 3] of the joints, by body."""
        positions = self.motion.positions()
        return {body: positions[:, node] for body, node in self.bodies.items()}

    @cached_property
    def rest(self) -> dict[str, np.ndarray]:
        """Positions [3] of the joints in the zero pose, by body."""
        rest = self.motion.rest()
        return {body: rest[node] for body, node in self.bodies.items()}

    @cached_property
    def turns(self) -> dict[str, Rotation]:
        """World rotations [T] of the segments away from the zero pose, by body.

        A bone may be several joints in a row, of which the others twist it: the one
        that carries the next joint turns a thigh. A fore arm is turned by the elbow,
        since the hand is welded to it in our body.
        """
        return {
            body: self.motion.turns(self._carrier(body))
            for body in self.bodies
            if not body.endswith(("hand", "toe"))
        }

    def _carrier(self, body: str) -> int:
        end = ENDS.get(body, "")
        if end in self.bodies and body.partition("_")[2] in (
            "thigh",
            "shin",
            "upper_arm",
        ):
            return self.motion.parents[self.bodies[end]]
        return self.bodies[body]

    def middle(self, part: str) -> np.ndarray:
        """The middle [T, 3] between the left and the right joint of a kind."""
        return 0.5 * (self.places[f"left_{part}"] + self.places[f"right_{part}"])

    def across(self, part: str) -> np.ndarray:
        """From the right joint of a kind to the left one, [T, 3]."""
        return self.places[f"left_{part}"] - self.places[f"right_{part}"]

    @cached_property
    def leg_length(self) -> float:
        """Thigh and shin, the mean of both sides, in the source's unit."""
        lengths = [
            np.linalg.norm(self.bone(f"{side}_{part}"), axis=1)
            for side in SIDES
            for part in ("thigh", "shin")
        ]
        return float(2.0 * np.mean([np.median(length) for length in lengths]))

    def bone(self, segment: str) -> np.ndarray:
        """From the upper to the lower end of a segment, [T, 3]; zero without an end."""
        end = self.places.get(ENDS[segment])
        start = self.places[segment]
        return np.zeros_like(start) if end is None else end - start

    def hinge(self, segment: str) -> tuple[np.ndarray, np.ndarray]:
        """Axis [T, 3] about which knee or elbow flexes, and how surely [T].

        The axis is the normal of the plane of both bones, its certainty the square of
        the sine between them.

        Args:
            segment: either of the two.
        """
        side, _, part = segment.partition("_")
        parts = ("thigh", "shin") if part in ("thigh", "shin") else HINGED[2:]
        upper, lower = (unit(self.bone(f"{side}_{p}")) for p in parts)
        normal = np.cross(upper, lower)
        return unit(normal), (normal**2).sum(axis=1)

    def within(self, segment: str, vectors: np.ndarray) -> np.ndarray:
        """World vectors [T, 3] as a segment's zero pose has them."""
        return self.turns[segment].inv().apply(vectors)


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length 1; what is zero stays so."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 1e-9, v / np.maximum(length, 1e-9), 0.0)


def across(v: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Unit vectors [..., 3] along v without what of it goes along a unit axis."""
    return unit(v - axis * (v * axis).sum(-1, keepdims=True))


def frame(up: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] with columns forward, left and up; up is kept exactly."""
    up = unit(up)
    left = across(left, up)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def shortest(a: np.ndarray, b: np.ndarray) -> Rotation:
    """The rotations [T] by the shortest way from directions a to b, both [T, 3]."""
    a, b = np.broadcast_arrays(unit(a), unit(b))
    half = unit(a + b)
    real = (a * half).sum(-1, keepdims=True)
    return Rotation.from_quat(np.concatenate([np.cross(a, half), real + 1e-12], -1))
