"""The page of figures and the video of a clip."""

from dataclasses import replace

import numpy as np
import pytest

from dcc_jax.character import asset_path, load_character
from dcc_jax.motion import inspect
from dcc_jax.motion.clip import load_clip


@pytest.fixture(scope="module")
def walk():
    return load_clip(asset_path("motions/walk_cycle.npz"))


def test_page_is_a_picture_of_every_kind_of_curve(walk, tmp_path):
    image = pytest.importorskip("imageio.v2")
    inspect.plot(walk, tmp_path / "new" / "page.png", fallback=True)
    page = image.imread(tmp_path / "new" / "page.png")
    assert page.shape[:2] == (1040, 1200)
    # Nothing is blank: strip, curves above, joints below all hold dark ink.
    for band in np.array_split(page[..., :3].astype(int).max(-1), 5):
        assert (band < 120).mean() > 0.002


def test_unknown_picture_format_is_refused(walk, tmp_path):
    with pytest.raises(ValueError, match=r"cannot write 'abc' pictures, only"):
        inspect.plot(walk, tmp_path / "page.abc")
    assert not list(tmp_path.iterdir())


def test_contacts_of_a_walk_alternate_and_overlap(walk):
    height, touching = inspect.sole_heights(walk, load_character())
    assert height.min() > -1e-3
    assert touching.any(axis=1).all()
    share = touching.mean(axis=0)
    np.testing.assert_allclose(share[0], share[1], atol=0.05)
    assert 0.5 < share[0] < 0.75
    assert 0.05 < touching.all(axis=1).mean() < 0.4


def test_range_violation_is_measured_from_the_limits(walk):
    character = load_character()
    knee = character.joint_names.index("left_knee")
    qpos = walk.qpos.copy()
    angle = character.upper[knee, 1] + 0.2
    first = 7 + 4 * knee
    qpos[:, first : first + 4] = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
    outside = inspect.outside_ranges(
        inspect.joint_angles(replace(walk, qpos=qpos)), character
    )
    np.testing.assert_allclose(outside[:, knee, 1], 0.2, atol=1e-5)
    assert outside[:, knee, [0, 2]].max() < 1e-5


def test_video_has_the_frames_of_the_clip(walk, tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    short = replace(walk, qpos=walk.qpos[:4], loop=False)
    inspect.video(short, tmp_path / "walk.mp4", fallback=True)
    with imageio.get_reader(tmp_path / "walk.mp4") as reader:
        shapes = [frame.shape for frame in reader]
    assert shapes == [(480, 640, 3)] * 4
