"""How good a clip is, in numbers.

Letters: T frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcc_jax.character import load_character
from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import rotations, split_qpos, to_rotation
from dcc_jax.motion.retarget.figure import FEET, figure, soles_of, world_of
from dcc_jax.motion.retarget.ground import contacts as find_contacts

TOUCH = 0.005  # m, under which a point of a sole is on the ground whatever it does


@dataclass(frozen=True)
class Quality:
    """The measures of one clip."""

    skate: float  # cm/s, mean slip of the points of standing parts of the feet
    low_skate: float  # cm/s, mean slip of all points less than `TOUCH` above ground
    penetration: float  # cm, deepest point of a sole below the ground
    float_height: float  # cm, mean height of the lowest point of a standing part
    standing: float  # share of the time in which some part of a foot stands
    range_excess: float  # degrees, furthest out of its range a joint goes
    range_share: float  # share of the frames in which some joint is out of range
    worst_joint: str  # the joint that goes furthest out; empty where none does
    root_jerk: float  # m/s^3, root mean square
    step_angle: float  # degrees, largest turn of a joint from one frame to the next

    def lines(self) -> list[str]:
        """The measures for a reader."""
        joint = f" ({self.worst_joint})" if self.worst_joint else ""
        return [
            f"foot skate in stance {self.skate:.2f} cm/s "
            f"(all points below {1e3 * TOUCH:.0f} mm: {self.low_skate:.2f} cm/s)",
            f"penetration {self.penetration:.2f} cm, float {self.float_height:.2f} cm, "
            f"standing {100.0 * self.standing:.0f} % of the time",
            f"joint ranges exceeded by up to {self.range_excess:.1f} degrees{joint} "
            f"in {100.0 * self.range_share:.0f} % of the frames",
            f"root jerk {self.root_jerk:.0f} m/s^3, "
            f"largest joint turn in a frame {self.step_angle:.1f} degrees",
        ]


def measure(clip: Clip, contacts: np.ndarray | None = None) -> Quality:
    """The quality of a clip.

    Args:
        clip: any clip.
        contacts: standing parts of the feet [T, 2, 2]; found in the clip by default.
    """
    if contacts is None:
        contacts = find_contacts(clip)
    height, slip = _soles(clip)
    standing = np.repeat(contacts, 2, axis=2)
    lowest = height.reshape(len(height), 2, 2, 2).min(axis=3)
    excess = _range_excess(clip)
    worst = excess.max(axis=0)
    joint = load_character().joint_names[int(worst.argmax())]
    steps = rotations(clip.qpos[:-1]).inv() * rotations(clip.qpos[1:])
    return Quality(
        skate=100.0 * _mean(slip[standing[1:] & standing[:-1]]),
        low_skate=100.0 * _mean(slip[(height[1:] < TOUCH) & (height[:-1] < TOUCH)]),
        penetration=100.0 * max(0.0, -float(height.min())),
        float_height=100.0 * _mean(np.maximum(lowest[contacts], 0.0)),
        standing=float(contacts.any(axis=(1, 2)).mean()),
        range_excess=float(np.degrees(worst.max())),
        range_share=float((excess > 0.0).any(axis=1).mean()),
        worst_joint=joint if worst.max() > 0.0 else "",
        root_jerk=_jerk(clip),
        step_angle=float(np.degrees(steps.magnitude()[:, 1:].max())),
    )


def pose_error(clip: Clip, wanted: np.ndarray) -> float:
    """Mean angle in degrees of the segments' world rotations to `wanted` [T, 13, 4]."""
    apart = to_rotation(world_of(clip.qpos)).inv() * to_rotation(wanted)
    return float(np.degrees(apart.magnitude().mean()))


def _soles(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Heights (m) of the points of the soles [T, 2, 4], and slips between frames (m/s).

    The slip is that of the sphere's lowest material point: a sphere that rolls has
    none, though its centre moves.
    """
    centres = soles_of(clip.qpos)
    feet = world_of(clip.qpos)[:, list(FEET)]
    turn = (to_rotation(feet[1:]) * to_rotation(feet[:-1]).inv()).as_rotvec()
    radius = figure().radius
    rolled = np.cross(turn, [0.0, 0.0, radius])[:, :, None]
    step = np.linalg.norm((np.diff(centres, axis=0) - rolled)[..., :2], axis=-1)
    return centres[..., 2] - radius, clip.fps * step


def _range_excess(clip: Clip) -> np.ndarray:
    """How far each joint is out of its range, [T, 12] rad."""
    character = load_character()
    vectors = to_rotation(split_qpos(clip.qpos)[1][:, 1:]).as_rotvec()
    over = np.maximum(vectors - character.upper, character.lower - vectors)
    return np.maximum(over, 0.0).max(axis=2)


def _jerk(clip: Clip) -> float:
    if len(clip.qpos) < 4:
        return 0.0
    jerk = np.diff(clip.qpos[:, :3].astype(float), 3, axis=0) * clip.fps**3
    return float(np.sqrt((jerk**2).sum(axis=1).mean()))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else 0.0
