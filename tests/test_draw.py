"""Pictures and videos."""

import dataclasses
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from dcc_jax.viz import draw, files
from dcc_jax.viz.fallback import Camera

SCENE = """<mujoco><worldbody>
<geom type="plane" size="5 5 .1"/>
<body name="ball" pos="0 0 .5"><freejoint/>
<geom type="sphere" size=".2" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""
VIEW = draw.View(azimuth=90.0, elevation=0.0, distance=3.0, height=0.5, body="ball")
FIXED = draw.View(azimuth=90.0, elevation=0.0, distance=3.0, height=0.5, body=None)
SIZE = (120, 100)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SCENE)


@pytest.fixture(params=[True, False], ids=["matplotlib", "opengl"])
def fallback(request) -> bool:
    if not request.param and not draw.opengl_works():
        pytest.skip("no OpenGL here")
    return request.param


def at(x: float, z: float = 0.5) -> np.ndarray:
    return np.array([x, 0.0, z, 1.0, 0.0, 0.0, 0.0])


def red(image: np.ndarray) -> np.ndarray:
    """Pixels (row, column) that are red, be they lit or in the shade of the rim."""
    wide = image.astype(int)
    return np.argwhere(wide[..., 0] > 2 * wide[..., 1:].max(-1) + 20)


def test_the_body_is_drawn_where_it_is(model, fallback):
    poses = np.stack([at(0.0), at(0.5)])
    images = list(draw.frames(model, poses, camera=FIXED, size=SIZE, fallback=fallback))
    assert [image.shape for image in images] == [(100, 120, 3)] * 2
    assert images[0].dtype == np.uint8
    # Looking along +y, x points to the right; the ball spans 2 * 0.2 m of 2.5 m.
    middle, moved = (red(image).mean(0) for image in images)
    np.testing.assert_allclose(middle, [50, 60], atol=4)
    np.testing.assert_allclose(moved - middle, [0, 0.5 * 100 / 2.485], atol=3)
    assert len(red(images[0])) == pytest.approx(np.pi * (0.2 * 40.2) ** 2, rel=0.1)


def test_the_camera_follows_the_body(model, fallback):
    images = draw.frames(
        model, np.stack([at(2.0)] * 2), camera=VIEW, size=SIZE, fallback=fallback
    )
    np.testing.assert_allclose(red(next(images)).mean(0), [50, 60], atol=4)


def test_a_camera_that_does_not_lag_has_the_body_in_the_middle(model, fallback):
    camera = dataclasses.replace(VIEW, smooth=0.0)
    path = np.stack([at(x) for x in (0.0, 1.0, 3.0)])
    images = draw.frames(model, path, camera=camera, size=SIZE, fallback=fallback)
    for image in images:
        np.testing.assert_allclose(red(image).mean(0), [50, 60], atol=4)


def test_ghost_and_arrows_change_the_picture(model, fallback):
    def picture(**extra) -> np.ndarray:
        return next(
            draw.frames(
                model,
                at(0.0)[None],
                camera=FIXED,
                size=SIZE,
                fallback=fallback,
                **extra,
            )
        ).astype(int)

    plain = picture()
    ghost = picture(ghost_qpos=at(0.6)[None])
    arrow = picture(arrows=[[(np.array([-0.3, 0, 0.5]), np.array([-0.4, 0, 0.0]))]])
    changed = np.argwhere(np.abs(ghost - plain).max(-1) > 12)
    np.testing.assert_allclose(changed.mean(0), [50, 60 + 0.6 * 40.2], atol=6)
    changed = np.argwhere(np.abs(arrow - plain).max(-1) > 40)
    np.testing.assert_allclose(changed.mean(0), [50, 60 - 0.5 * 40.2], atol=6)


def test_ghost_is_drawn_only_where_it_is_apart(model, fallback):
    def picture(**extra) -> np.ndarray:
        poses = at(0.0)[None]
        images = draw.frames(
            model, poses, camera=FIXED, size=SIZE, fallback=fallback, **extra
        )
        return next(images).astype(int)

    assert not np.any(picture(ghost_qpos=at(0.002)[None]) - picture())
    assert np.any(picture(ghost_qpos=at(0.02)[None]) - picture())


def test_arrow_points_from_tail_to_tip_in_front_of_everything(model, fallback):
    arrow = (np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 0.4]))
    plain, drawn = (
        next(
            draw.frames(
                model,
                at(0.0)[None],
                camera=FIXED,
                size=SIZE,
                fallback=fallback,
                arrows=arrows,
            )
        ).astype(int)
        for arrows in (None, [[arrow]])
    )
    changed = np.argwhere(np.abs(drawn - plain).max(-1) > 20)
    top, bottom = changed[:, 0].min(), changed[:, 0].max()
    # From the middle of the ball, inside it, 0.4 m up; the head, 8 pixels long, is
    # wider than the shaft.
    assert [top, bottom] == pytest.approx([50 - 0.4 * 40.2, 50], abs=2)
    width = [np.sum(changed[:, 0] == row) for row in (top + 6, bottom - 3)]
    assert width[0] > width[1] > 0


def test_caption_is_written_at_the_top(model, fallback):
    plain, written = (
        next(
            draw.frames(
                model,
                at(0.0)[None],
                camera=FIXED,
                size=SIZE,
                fallback=fallback,
                captions=captions,
            )
        ).astype(int)
        for captions in (None, ["alpha"])
    )
    rows = np.argwhere(np.abs(written - plain).max(-1) > 0)[:, 0]
    assert len(rows) > 20 and rows.max() < 25


def test_kinematic_bodies_are_drawn_where_they_are_put(fallback):
    text = SCENE.replace("<freejoint/>", "").replace('"ball"', '"ball" mocap="true"')
    model = mujoco.MjModel.from_xml_string(text)
    upright = np.array([[[1.0, 0.0, 0.0, 0.0]]])
    for x in (0.0, 0.5):
        place = np.array([[[x, 0.0, 0.5]]])
        images = draw.frames(
            model,
            np.zeros((1, 0)),
            camera=FIXED,
            size=SIZE,
            fallback=fallback,
            mocap=(place, upright),
        )
        middle = red(next(images)).mean(0)
        np.testing.assert_allclose(middle, [50, 60 + x * 40.2], atol=3)


def test_plate_nearer_than_its_far_edge_hides_nothing_on_it(fallback):
    """matplotlib paints shapes in turn: the plate has to come before what is on it."""
    text = SCENE.replace(
        '<geom type="plane" size="5 5 .1"/>',
        '<geom type="box" size="1.5 1.5 .05" pos="0 -0.5 .2" rgba="0 0 1 1"/>',
    )
    model = mujoco.MjModel.from_xml_string(text)
    images = draw.frames(
        model, at(0.0)[None], camera=FIXED, size=SIZE, fallback=fallback
    )
    count = len(red(next(images)))
    assert count == pytest.approx(np.pi * (0.2 * 40.2) ** 2, rel=0.1)


def test_the_plain_camera_agrees_with_the_pinhole_equation():
    camera = Camera(np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 2.0, (100, 100))
    pixels, depth = camera.project(np.array([[0.0, 0.0, 1.0], [0.0, -0.5, 1.5]]))
    focal = 50.0 / np.tan(np.radians(22.5))
    np.testing.assert_allclose(depth, 2.0)
    np.testing.assert_allclose(pixels[0], [50.0, 50.0])
    np.testing.assert_allclose(pixels[1], 50.0 + focal * np.array([0.25, 0.25]))


def test_wrong_shapes_are_refused(model):
    with pytest.raises(
        ValueError, match=r"qpos must have shape \(2, 7\), got \(2, 6\)"
    ):
        draw.frames(model, np.zeros((2, 6)))
    with pytest.raises(ValueError, match="ghost_qpos must have shape"):
        draw.frames(model, np.zeros((2, 7)), ghost_qpos=np.zeros((1, 7)))
    with pytest.raises(ValueError, match="arrows has 1 frames, qpos has 2"):
        draw.frames(model, np.zeros((2, 7)), arrows=[[]])
    with pytest.raises(ValueError, match="captions has 1 frames, qpos has 2"):
        draw.frames(model, np.zeros((2, 7)), captions=[""])


def test_machine_without_display_is_asked_once():
    """MuJoCo aborts the process when it fails to draw a second time."""
    code = "from dcc_jax.viz import draw; draw.opengl_works(); draw.opengl_works()"
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**environment, "MUJOCO_GL": "glfw"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    if sys.platform == "linux":
        assert done.stderr.count("drawing with matplotlib") == 1


@pytest.mark.parametrize("libraries", ["all", "none"])
def test_drawing_leaves_the_environment_to_the_caller_and_its_children(libraries):
    """A child that inherits a MUJOCO_GL without its library cannot import mujoco."""
    code = """
import os, subprocess, sys
from dcc_jax.viz import draw, files
if sys.argv[1] == "none":
    draw.find_library = lambda name: None
before = dict(os.environ)
draw.opengl_works()
assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())
subprocess.run([sys.executable, "-c", "import mujoco"], check=True)
"""
    hidden = ("DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")
    done = subprocess.run(
        [sys.executable, "-c", code, libraries],
        env={k: v for k, v in os.environ.items() if k not in hidden},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    if libraries == "none" and sys.platform == "linux":
        assert "no display, no libOSMesa and no libEGL" in done.stderr


def test_only_our_own_renderer_is_given_another_context(model, monkeypatch):
    """The caller's `mujoco.Renderer` draws with what MuJoCo chose for it."""
    chosen = sys.modules[mujoco.Renderer.__module__].gl_context
    before, used = chosen.GLContext, []
    context = object()
    monkeypatch.setattr(draw, "_headless_context", lambda: context)
    monkeypatch.setattr(
        mujoco,
        "Renderer",
        type(
            "Renderer",
            (mujoco.Renderer,),
            {
                "__module__": mujoco.Renderer.__module__,
                "__init__": lambda self, *_, **__: used.append(chosen.GLContext),
                "__del__": lambda self: None,
            },
        ),
    )
    draw._renderer(model, 8, 8)
    assert used == [context]
    assert chosen.GLContext is before


def test_video_holds_every_frame(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    images = [np.full((64, 64, 3), 20 * k, np.uint8) for k in range(7)]
    files.write_mp4(tmp_path / "new" / "clip.mp4", iter(images), fps=30)
    with imageio.get_reader(tmp_path / "new" / "clip.mp4") as reader:
        levels = [frame.mean() for frame in reader]
        assert reader.get_meta_data()["fps"] == 30
    np.testing.assert_allclose(levels, [20 * k for k in range(7)], atol=4)


def test_missing_video_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match=r"dcc-jax\[video\]"):
        files.write_mp4(tmp_path / "clip.mp4", iter([]), fps=30)


def test_missing_ffmpeg_is_told_before_the_work(tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def missing():
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(OSError, match=r"clip.mp4 needs ffmpeg: No ffmpeg exe"):
        files.check_video(tmp_path / "clip.mp4")


def test_unwritable_folder_of_a_video_is_told_before_the_work(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    # To root every folder is writable.
    monkeypatch.setattr(draw.os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(PermissionError, match=r"clip.mp4 cannot be written"):
        files.check_video(tmp_path / "clip.mp4")
