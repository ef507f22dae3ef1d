"""Drawing the shapes of a model with matplotlib, where there is no OpenGL.

Every capsule, sphere, cylinder and box becomes its silhouette, painted from back to
front.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

Array = np.ndarray
FIELD_OF_VIEW = np.radians(45.0)  # vertical, MuJoCo's default
NEAR = 0.05  # m
SKY, GROUND, GRID = "#dfeaf5", "#e3e3df", "#cdcdc8"
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], -1)
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


def plain_frames(
    model: mujoco.MjModel,
    qpos: Array,
    cameras: Sequence[Camera],
    ghost: Array | None,
    arrows: Sequence[Sequence[tuple[Array, Array]]] | None,
    tints: tuple[Array, Array],
) -> Iterator[Array]:
    """One picture [height, width, 3] uint8 a pose.

    Args:
        model: the scene.
        qpos: coordinates [T, nq].
        cameras: one a frame.
        ghost: coordinates [T, nq] of a translucent copy.
        arrows: per frame, pairs of point and vector [3].
        tints: colours [4] of the ghost and of the arrows.
    """
    data = mujoco.MjData(model)
    for index, q in enumerate(qpos):
        camera = cameras[index]
        width, height = camera.size
        figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=SKY)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(0, height))
        axes.axis("off")
        _draw_ground(axes, camera, camera.position + camera.forward * 3.0)
        if ghost is not None:
            data.qpos[:] = ghost[index]
            _draw_geoms(axes, camera, model, data, tints[0], moving_only=True)
        data.qpos[:] = q
        _draw_geoms(axes, camera, model, data, None)
        for point, vector in arrows[index] if arrows is not None else ():
            tail, tip = camera.project(np.stack([point, np.add(point, vector)]))[0]
            axes.annotate(
                "",
                tip,
                tail,
                arrowprops={"color": tints[1], "width": 3, "headwidth": 9},
                zorder=10,
            )
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


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
    axes.add_collection(LineCollection(pieces[visible], colors=GRID, lw=0.8, zorder=1))


def _draw_geoms(
    axes: Axes,
    camera: Camera,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    tint: Array | None,
    moving_only: bool = False,
) -> None:
    """The silhouettes of all shapes, the farthest first."""
    mujoco.mj_kinematics(model, data)
    items = []
    for geom in range(model.ngeom):
        if model.geom_group[geom] > 2:
            continue
        if moving_only and model.geom_bodyid[geom] == 0:
            continue
        outline = _outline(camera, model, data, geom)
        if outline is not None:
            depth = float(camera.project(data.geom_xpos[geom])[1])
            items.append((depth, outline, model.geom_rgba[geom]))
    items.sort(key=lambda item: -item[0])
    colours = [colour if tint is None else tint for _, _, colour in items]
    outlines = [outline for _, outline, _ in items]
    shapes = PolyCollection(outlines, facecolors=colours, edgecolors="none", zorder=2)
    axes.add_collection(shapes)


def _outline(
    camera: Camera, model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> Array | None:
    """Corners [P, 2] in pixels of the silhouette of a geom, none of a plane."""
    kind = int(model.geom_type[geom])
    place, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
        corners = place + (signs * model.geom_size[geom]) @ turn.T
        return _hull(camera.project(corners)[0])
    if kind not in LINE_KINDS:
        return None
    half = 0.0 if kind in ROUND_KINDS else model.geom_size[geom, 1]
    ends, depth = camera.project(place + np.outer([-1.0, 1.0], half * turn[:, 2]))
    radius = model.geom_size[geom, 0] * camera.focal / depth
    return _hull((ends[:, None] + radius[:, None, None] * CIRCLE).reshape(-1, 2))


def _hull(pixels: Array) -> Array:
    return pixels[ConvexHull(pixels, qhull_options="QJ").vertices]
