"""A floor without end."""

from __future__ import annotations

import numpy as np
import viser

from dcc_jax.view import shapes

TILES = 30  # of 1 m, along an edge of what is drawn
COLOURS = (236, 236, 232), (214, 215, 213)
LINES = (190, 190, 186)


class Floor:
    """Tiles, or lines where they take too long.

    viser's own grid takes a second a picture where there is no graphics card.
    """

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._middle = np.zeros(3)
        self._tiles = [
            scene.add_mesh_simple(
                f"{root}/floor/{i}",
                *shapes.tiles(TILES, parity=i),
                color=colour,
                cast_shadow=False,
            )
            for i, colour in enumerate(COLOURS)
        ]
        self._lines = scene.add_line_segments(
            f"{root}/lines",
            shapes.grid(TILES),
            LINES,
            thickness=1.0,
            thickness_units="screen",
        )

    def set_plain(self, plain: bool) -> None:
        """Lines in place of tiles."""
        for tiles in self._tiles:
            tiles.visible = not plain
        self._lines.visible = plain

    def follow(self, root: np.ndarray) -> None:
        """Goes along with a point [3], by whole pairs of tiles."""
        middle = 2.0 * np.round(0.5 * root)
        if np.any(middle != self._middle):
            self._middle = middle
            for floor in (*self._tiles, self._lines):
                floor.position = middle
