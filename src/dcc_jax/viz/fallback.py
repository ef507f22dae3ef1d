"""Drawing without OpenGL: the shapes of a model, and arrows and text on any picture.

Every capsule, sphere, cylinder and box becomes its silhouette, painted from back to
front.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull

Array = np.ndarray
FIELD_OF_VIEW = np.radians(45.0)  # vertical, MuJoCo's default
NEAR = 0.05  # m
SKY, GROUND, GRID = "#dfeaf5", "#e3e3df", "#cdcdc8"
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], -1)
SIGNS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
ARROW = "#f2590f"
FONT = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
GHOST_GAP = 0.005  # m; shapes of the ghost nearer to the body's are not drawn
GRID_REACH = 12  # m, of the ground's lines around the point looked at
ROUND_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID),
}
LINE_KINDS = ROUND_KINDS | {
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
}


class Camera:
    """A pinhole camera as MuJoCo's free camera."""

    def __init__(
        self,
        looked_at: Array,
        azimuth: float,
        elevation: float,
        distance: float,
        size: tuple[int, int],
    ) -> None:
        """Angles in degrees, distance in m, size in pixels."""
        azimuth, elevation = np.radians([azimuth, elevation])
        self.forward = np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        self.right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        self.up = np.cross(self.right, self.forward)
        self.position = looked_at - distance * self.forward
        self.size = size
        self.focal = 0.5 * size[1] / np.tan(0.5 * FIELD_OF_VIEW)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels [..., 2], y upward, and depth [...] in m of points [..., 3]."""
        arm = points - self.position
        depth = np.maximum(arm @ self.forward, NEAR)
        across = np.stack([arm @ self.right, arm @ self.up], -1)
        return 0.5 * np.array(self.size) + self.focal * across / depth[..., None], depth


@dataclass(frozen=True)
class Poses:
    """A model along a motion, and along that of its ghost."""

    model: mujoco.MjModel
    qpos: Array  # [T, nq]
    ghost: Array | None  # [T, nq]
    mocap: tuple[Array, Array] | None  # [T, nmocap, 3] and [T, nmocap, 4]

    def __iter__(self) -> Iterator[tuple[mujoco.MjData, mujoco.MjData | None]]:
        """Each pose as MuJoCo's data, positions computed; valid until the next one."""
        data, second = mujoco.MjData(self.model), mujoco.MjData(self.model)
        for index in range(len(self.qpos)):
            self._set(data, self.qpos[index], index)
            if self.ghost is not None:
                self._set(second, self.ghost[index], index)
            yield data, None if self.ghost is None else second

    def _set(self, data: mujoco.MjData, q: Array, index: int) -> None:
        data.qpos[:] = q
        if self.mocap is not None:
            data.mocap_pos[:], data.mocap_quat[:] = (x[index] for x in self.mocap)
        mujoco.mj_fwdPosition(self.model, data)

    def apart(self, data: mujoco.MjData, ghost: mujoco.MjData) -> Array:
        """Which geoms of the ghost [ngeom] are not where the body's are."""
        gap = np.linalg.norm(data.geom_xpos - ghost.geom_xpos, axis=1)
        turn = np.linalg.norm(data.geom_xmat - ghost.geom_xmat, axis=1)
        return gap + self.model.geom_rbound * turn > GHOST_GAP


def plain_frames(
    poses: Poses, cameras: Sequence[Camera], tint: Array
) -> Iterator[Array]:
    """One picture [height, width, 3] uint8 a pose.

    Args:
        poses: T of them.
        cameras: one a frame.
        tint: colour [4] of the ghost.
    """
    planes = poses.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    everything = np.ones(poses.model.ngeom, bool)
    for camera, (data, ghost) in zip(cameras, poses, strict=True):
        width, height = camera.size
        figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=SKY)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(0, height))
        axes.axis("off")
        if planes.any():
            _draw_ground(axes, camera, camera.position + camera.forward * 3.0)
        if ghost is not None:
            apart = poses.apart(data, ghost)
            _draw_geoms(axes, camera, poses.model, ghost, apart, tint)
        _draw_geoms(axes, camera, poses.model, data, everything, None)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def annotate(
    image: Array,
    camera: Camera,
    arrows: Sequence[tuple[Array, Array]],
    caption: str = "",
) -> Array:
    """The picture with arrows (tail and vector, world, m) and a line of text on it."""
    drawn = [arrow for arrow in arrows if np.linalg.norm(arrow[1]) > 1e-3]
    if not drawn and not caption:
        return image
    canvas = Image.fromarray(image)
    pen, height = ImageDraw.Draw(canvas), image.shape[0]
    for point, vector in drawn:
        ends, _ = camera.project(np.stack([point, np.add(point, vector)]))
        _draw_arrow(pen, max(2.0, 0.01 * height), *(ends * [1, -1] + [0, height]))
    if caption:
        font = ImageFont.truetype(str(FONT), max(10, height // 32))
        ink = {"fill": "black", "stroke_width": 2, "stroke_fill": "white"}
        pen.text((8, 5), caption, font=font, **ink)
    return np.asarray(canvas)


def _draw_arrow(
    pen: ImageDraw.ImageDraw, width: float, tail: Array, tip: Array
) -> None:
    """A shaft of some width and a head, in pixels, y downward."""
    along = (tip - tail) / max(float(np.linalg.norm(tip - tail)), 1e-6)
    across = width * np.array([-along[1], along[0]])
    neck = tip - min(float(np.linalg.norm(tip - tail)), 4.0 * width) * along
    outline = [
        *(tail + 0.5 * across, neck + 0.5 * across, neck + 1.5 * across, tip),
        *(neck - 1.5 * across, neck - 0.5 * across, tail - 0.5 * across),
    ]
    pen.polygon([tuple(corner) for corner in outline], fill=ARROW)


def _draw_ground(axes: Axes, camera: Camera, around: Array) -> None:
    horizon, _ = camera.project(camera.position + 1e4 * camera.forward * [1, 1, 0])
    axes.axhspan(0.0, float(horizon[1]), color=GROUND, zorder=0)
    centre = np.round(around[:2])
    steps = np.arange(-GRID_REACH, GRID_REACH + 1.0)
    along = np.linspace(-GRID_REACH, GRID_REACH, 49)
    rows = np.stack(np.broadcast_arrays(along[None], steps[:, None], 0.0), -1)
    origin = np.array([*centre, 0.0])
    lines = origin + np.concatenate([rows, rows[..., [1, 0, 2]]])
    pixels, depth = camera.project(lines)
    pieces = np.stack([pixels[:, :-1], pixels[:, 1:]], 2).reshape(-1, 2, 2)
    visible = (np.minimum(depth[:, :-1], depth[:, 1:]) > 2 * NEAR).ravel()
    axes.add_collection(
        LineCollection(list(pieces[visible]), colors=GRID, lw=0.8, zorder=1)
    )


def _draw_geoms(
    axes: Axes,
    camera: Camera,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    shown: Array,
    tint: Array | None,
) -> None:
    """The silhouettes of shapes, the one that reaches farthest first."""
    items = []
    for geom in np.flatnonzero(shown & (model.geom_group <= 2)).tolist():
        outline = _outline(camera, model, data, geom)
        if outline is not None:
            depth = camera.project(_corners(model, data, geom))[1].max()
            items.append((depth, outline, model.geom_rgba[geom]))
    items.sort(key=lambda item: -item[0])
    colours = [colour if tint is None else tint for _, _, colour in items]
    outlines = [outline for _, outline, _ in items]
    shapes = PolyCollection(outlines, facecolors=colours, edgecolors="none", zorder=2)
    axes.add_collection(shapes)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Array:
    """Corners [8, 3] of the box around a geom, world, m."""
    middle, half = model.geom_aabb[geom].reshape(2, 3)
    turn = data.geom_xmat[geom].reshape(3, 3)
    return data.geom_xpos[geom] + (middle + SIGNS * half) @ turn.T


def _outline(
    camera: Camera, model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> Array | None:
    """Corners [P, 2] in pixels of the silhouette of a geom, none of a plane."""
    kind = int(model.geom_type[geom])
    place, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _hull(camera.project(_corners(model, data, geom))[0])
    if kind not in LINE_KINDS:
        return None
    half = 0.0 if kind in ROUND_KINDS else model.geom_size[geom, 1]
    ends, depth = camera.project(place + np.outer([-1.0, 1.0], half * turn[:, 2]))
    radius = model.geom_size[geom, 0] * camera.focal / depth
    return _hull((ends[:, None] + radius[:, None, None] * CIRCLE).reshape(-1, 2))


def _hull(pixels: Array) -> Array:
    return pixels[ConvexHull(pixels, qhull_options="QJ").vertices]
