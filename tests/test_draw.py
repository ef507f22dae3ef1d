"""Pictures and videos."""

import sys

import mujoco
import numpy as np
import pytest

from dcc_jax import draw
from dcc_jax.draw_plain import Camera

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
    """Pixels (row, column) that are clearly red."""
    wide = image.astype(int)
    return np.argwhere((wide[..., 0] > 90) & (wide[..., 1:].max(-1) < 60))


def test_the_body_is_drawn_where_it_is(model, fallback):
    poses = np.stack([at(0.0), at(0.5)])
    images = list(draw.frames(model, poses, camera=FIXED, size=SIZE, fallback=fallback))
    assert [image.shape for image in images] == [(100, 120, 3)] * 2
    assert images[0].dtype == np.uint8
    # Looking along +y, x points to the right; the ball spans 2 * 0.2 m of 2.5 m.
    middle, moved = (red(image).mean(0) for image in images)
    np.testing.assert_allclose(middle, [50, 60], atol=4)
    np.testing.assert_allclose(moved - middle, [0, 0.5 * 100 / 2.485], atol=3)
    assert len(red(images[0])) == pytest.approx(np.pi * (0.2 * 40.2) ** 2, rel=0.25)


def test_the_camera_follows_the_body(model, fallback):
    images = draw.frames(
        model, np.stack([at(2.0)] * 2), camera=VIEW, size=SIZE, fallback=fallback
    )
    np.testing.assert_allclose(red(next(images)).mean(0), [50, 60], atol=4)


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


def test_video_holds_every_frame(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    images = [np.full((64, 64, 3), 20 * k, np.uint8) for k in range(7)]
    draw.write_mp4(tmp_path / "new" / "clip.mp4", iter(images), fps=30)
    with imageio.get_reader(tmp_path / "new" / "clip.mp4") as reader:
        levels = [frame.mean() for frame in reader]
        assert reader.get_meta_data()["fps"] == 30
    np.testing.assert_allclose(levels, [20 * k for k in range(7)], atol=4)


def test_missing_video_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match=r"dcc-jax\[video\]"):
        draw.write_mp4(tmp_path / "clip.mp4", iter([]), fps=30)
