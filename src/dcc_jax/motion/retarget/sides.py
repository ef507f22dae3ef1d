"""Left and right: figures whose sides are swapped, or written in left-handed axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.retarget import words
from dcc_jax.motion.retarget.anatomy import Anatomy, across, unit

SIDES = ("keep", "swap", "mirror")  # what the user can ask for
POINTING = 0.3  # cosine from which toes point somewhere
BENDING = 0.05  # mean square sine of knees that bend


def with_sides(figure: Anatomy, how: str) -> Anatomy:
    """The figure with other sides.

    Args:
        figure: as read.
        how: of `SIDES`: `swap` takes joints called left for right ones, `mirror` turns
            left-handed axes into right-handed ones.
    """
    if how == "swap":
        other = {"left": "right", "right": "left"}
        bodies = {
            f"{other[head]}_{part}"
            if (head := body.partition("_")[0]) in other
            else body: node
            for body, node in figure.bodies.items()
            for part in [body.partition("_")[2]]
        }
        return Anatomy(figure.motion, bodies)
    if how == "mirror":
        return Anatomy(_mirrored(figure.motion), figure.bodies)
    return figure


def _mirrored(motion: Motion) -> Motion:
    """The motion with the x axis turned round."""
    flip = np.array([-1.0, 1.0, 1.0])
    return replace(
        motion,
        offsets=motion.offsets * flip,
        root=motion.root * flip,
        quats=motion.quats * [1.0, 1.0, -1.0, -1.0],
        moves={node: move * flip for node, move in motion.moves.items()},
    )


def sides_defect(figure: Anatomy) -> str:
    """Why left and right cannot be as the names say; empty where they can.

    Knees bend backwards and toes point ahead. Ahead follows from left and up: where all
    knees and toes deny it, the sides are swapped or the axes left-handed.
    """
    trunk = unit(figure.middle("upper_arm") - figure.middle("thigh"))
    left = across(figure.across("thigh"), trunk)
    ahead = np.cross(left, trunk)
    knees, toes = 0.0, []
    for side in words.SIDES:
        axis, surely = figure.hinge(f"{side}_thigh")
        knees += float((surely * (axis * left).sum(axis=1)).mean())
        toe = unit(figure.bone(f"{side}_foot"))
        down = unit(figure.bone(f"{side}_shin"))
        toes.append(float((across(toe, down) * ahead).sum(axis=1).mean()))
    pointing = [toe for toe in toes if abs(toe) > POINTING]
    against = bool(pointing) and max(pointing) < 0.0
    if against and knees < 0.02:
        return "knees and toes point backwards"
    if not pointing and knees < -BENDING:
        return "knees bend forwards"
    return ""


def refuse_swapped_sides(figure: Anatomy) -> None:
    """Refuses a figure whose left is its right.

    Raises:
        MotionError: it is one.
    """
    defect = sides_defect(figure)
    if defect:
        raise MotionError(
            figure.motion.path,
            f"{defect} if left and right are as named: sides are swapped "
            "(--sides swap) or the axes are left-handed (--sides mirror)",
        )
