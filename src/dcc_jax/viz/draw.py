"""Pictures of a MuJoCo model along a motion.

MuJoCo's offscreen renderer draws where there is a display, libOSMesa or libEGL;
elsewhere matplotlib draws the shapes of the bodies. `MUJOCO_GL` decides
where it is set.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d

from dcc_jax.viz.fallback import Camera, Poses, annotate, plain_frames

Arrow = tuple[np.ndarray, np.ndarray]
"""A force arrow: where it begins and the vector to draw, both [3], world, m."""

GHOST = np.array([0.35, 0.75, 0.95, 0.35], np.float32)


@dataclass(frozen=True)
class View:
    """A camera that follows the character: angles in degrees, distance in m."""

    azimuth: float = 130.0  # 90 looks along +y, 180 along -x
    elevation: float = -12.0
    distance: float = 3.4
    height: float = 0.85  # of the point looked at, above the ground
    body: str | None = "pelvis"  # whose ground position is followed; None: stand still
    target: tuple[float, float] = (0.0, 0.0)  # where to look when nothing is followed
    smooth: float = 6.0  # frames, of the following; 0: it keeps up


def frames(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    *,
    camera: View | None = None,
    size: tuple[int, int] = (640, 480),
    ghost_qpos: np.ndarray | None = None,
    arrows: Sequence[Sequence[Arrow]] | None = None,
    captions: Sequence[str] | None = None,
    mocap: tuple[np.ndarray, np.ndarray] | None = None,
    fallback: bool | None = None,
) -> Iterator[np.ndarray]:
    """Draws one picture a pose.

    Args:
        model: the scene.
        qpos: its coordinates [T, nq].
        camera: from where; the default follows the pelvis from the front left.
        size: width and height in pixels.
        ghost_qpos: a second, translucent copy of the moving bodies [T, nq].
        arrows: per frame, the force arrows to draw, in front of everything.
        captions: per frame, a line of text at the top.
        mocap: positions [T, nmocap, 3] and orientations [T, nmocap, 4] of the model's
            kinematic bodies; None: as the model has them.
        fallback: draw with matplotlib (True), with OpenGL (False), or with what works.

    Yields:
        images [height, width, 3] uint8.

    Raises:
        ValueError: shapes that do not match the model or one another.
    """
    qpos = np.asarray(qpos, float)
    _check("qpos", qpos, model.nq, len(qpos))
    if ghost_qpos is not None:
        _check("ghost_qpos", np.asarray(ghost_qpos), model.nq, len(qpos))
    for name, rows in {"arrows": arrows, "captions": captions}.items():
        if rows is not None and len(rows) != len(qpos):
            raise ValueError(f"{name} has {len(rows)} frames, qpos has {len(qpos)}")
    view = View() if camera is None else camera
    if fallback is None:
        fallback = not opengl_works()
    looked_at = _follow(model, qpos, view)
    angles = (view.azimuth, view.elevation, view.distance)
    cameras = [Camera(point, *angles, size) for point in looked_at]
    ghost = None if ghost_qpos is None else np.asarray(ghost_qpos, float)
    poses = Poses(model, qpos, ghost, mocap)
    if fallback:
        images = plain_frames(poses, cameras, GHOST)
    else:
        images = _opengl_frames(poses, view, looked_at, size)
    return _annotated(images, cameras, arrows, captions)


def _annotated(
    images: Iterator[np.ndarray],
    cameras: Sequence[Camera],
    arrows: Sequence[Sequence[Arrow]] | None,
    captions: Sequence[str] | None,
) -> Iterator[np.ndarray]:
    for index, image in enumerate(images):
        chosen = () if arrows is None else arrows[index]
        text = "" if captions is None else captions[index]
        yield annotate(image, cameras[index], chosen, text)


def _check(name: str, q: np.ndarray, nq: int, count: int) -> None:
    if q.ndim != 2 or q.shape != (count, nq):
        raise ValueError(f"{name} must have shape ({count}, {nq}), got {q.shape}")


@cache
def opengl_works() -> bool:
    """Whether MuJoCo can draw offscreen here; says so when it cannot.

    Asked once: after a failure MuJoCo aborts the process at the next attempt.
    """
    try:
        probe = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw tells at length
            _renderer(probe, 8, 8).close()
        return True
    except Exception as error:  # every GL backend fails with a type of its own
        print(f"no OpenGL here ({error}): drawing with matplotlib", file=sys.stderr)
        return False


def _renderer(
    model: mujoco.MjModel, height: int, width: int, **options: Any
) -> mujoco.Renderer:
    """MuJoCo's renderer, without a display where there is none.

    MuJoCo chooses its OpenGL by MUJOCO_GL when it is imported. To set that variable
    here would be too late, and would reach every child process. So the renderer is
    given another context while it is made.
    """
    context = _headless_context()
    if context is None:
        return mujoco.Renderer(model, height, width, **options)
    chosen = sys.modules[mujoco.Renderer.__module__].gl_context
    before, chosen.GLContext = chosen.GLContext, context
    try:
        return mujoco.Renderer(model, height, width, **options)
    finally:
        chosen.GLContext = before


@cache
def _headless_context() -> Any:
    """MuJoCo's context for drawing without a display; None: the one it chose itself.

    Raises:
        RuntimeError: neither a display nor a library that does without.
    """
    said = os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY")
    if sys.platform != "linux" or said:
        return None
    for name in ("OSMesa", "EGL"):
        if find_library(name):
            with _environment_restored("PYOPENGL_PLATFORM"):
                return importlib.import_module(f"mujoco.{name.lower()}").GLContext
    raise RuntimeError("no display, no libOSMesa and no libEGL")


@contextlib.contextmanager
def _environment_restored(name: str) -> Iterator[None]:
    """Undoes what is done to an environment variable, for the sake of children."""
    before = os.environ.get(name)
    try:
        yield
    finally:
        os.environ.pop(name, None)
        if before is not None:
            os.environ[name] = before


def _follow(model: mujoco.MjModel, qpos: np.ndarray, view: View) -> np.ndarray:
    """The point [T, 3] the camera looks at."""
    path = np.broadcast_to([*view.target, view.height], (len(qpos), 3)).copy()
    if view.body is not None:
        data = mujoco.MjData(model)
        body = model.body(view.body).id
        for index, q in enumerate(qpos):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            path[index, :2] = data.xpos[body, :2]
    if view.smooth == 0.0:
        return path
    return gaussian_filter1d(path, view.smooth, axis=0, mode="nearest")


def _opengl_frames(
    poses: Poses, view: View, looked_at: np.ndarray, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    width, height = size
    model = poses.model
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.azimuth, camera.elevation = view.azimuth, view.elevation
    camera.distance = view.distance
    with _renderer(model, height, width, max_geom=4000) as renderer:
        for (data, ghost), point in zip(poses, looked_at, strict=True):
            camera.lookat[:] = point
            renderer.update_scene(data, camera, option)
            if ghost is not None:
                _add_ghost(poses, data, ghost, option, renderer.scene)
            yield renderer.render().copy()


def _add_ghost(
    poses: Poses,
    data: mujoco.MjData,
    ghost: mujoco.MjData,
    option: mujoco.MjvOption,
    scene: mujoco.MjvScene,
) -> None:
    first = scene.ngeom
    dynamic, nothing = int(mujoco.mjtCatBit.mjCAT_DYNAMIC), mujoco.MjvPerturb()
    mujoco.mjv_addGeoms(poses.model, ghost, option, nothing, dynamic, scene)
    apart = poses.apart(data, ghost)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = GHOST if apart[geom.objid] else 0.0
        geom.matid = -1
