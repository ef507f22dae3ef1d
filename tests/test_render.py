"""Films of a policy that was hardly trained: files, arrows, ghost, bad input."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

import smoke
from dcc_jax import quat
from dcc_jax.config import make_config
from dcc_jax.play.recording import Motion, displaced
from dcc_jax.render import film, pictures
from dcc_jax.training.loop import make_environment
from dcc_jax.viz import draw, files

# The package shows the function of that name; these tests want the module.
command = importlib.import_module("dcc_jax.render.__main__")

pytestmark = pytest.mark.xdist_group("push")
SECONDS = 1.5  # as in the tests of the evaluation: one compiled program serves both


@pytest.fixture(scope="module")
def push(smoke_run: Callable[[str], Path]) -> Path:
    return smoke_run("push")


@pytest.fixture(scope="module")
def plan(push: Path, tmp_path_factory: pytest.TempPathFactory) -> film.FilmPlan:
    folder = tmp_path_factory.mktemp("film")
    mp4, png, gif = folder / "new" / "a.mp4", folder / "a.png", folder / "a.gif"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film, "Player", smoke.player)
        plan = film.prepare(push, out=mp4, seconds=SECONDS, seed=3, strip=png, gif=gif)
    return dataclasses.replace(plan, size=(320, 240))


@pytest.fixture(scope="module")
def shot(plan: film.FilmPlan) -> film.Shot:
    """What `python -m dcc_jax.render` does, without its command line."""
    found = film.play(plan)
    film.write(plan, found)
    return found


def test_video_is_as_long_as_asked_for_and_moves(plan, shot):
    imageio = pytest.importorskip("imageio.v2")
    with imageio.get_reader(plan.out) as reader:
        images = [image.astype(int) for image in reader]
        assert reader.get_meta_data()["fps"] == 30
    assert shot.count == len(images) == round(SECONDS * 30)
    assert images[0].shape == (240, 320, 3)
    assert np.abs(images[-1] - images[0]).mean() > 1.0


def test_films_are_of_720_lines():
    assert film.SIZE == (1280, 720) == film.FilmPlan.size


def test_gif_loops_at_half_the_rate(plan, shot):
    with Image.open(plan.gif) as gif:
        assert gif.n_frames == shot.count // 2 + shot.count % 2
        assert gif.size == (480, 360)
        assert gif.info["loop"] == 0
        assert gif.info["duration"] == pytest.approx(1000 / 15, abs=10)


def test_strip_is_twelve_frames_of_half_the_size_on_a_page(plan, shot):
    page = imread(plan.strip)[..., :3]
    assert page.shape == (3 * 120, 4 * 160, 3)
    parts = page.reshape(3, 120, 4, 160, 3).swapaxes(1, 2).reshape(12, 120, 160, 3)
    assert all(part.std() > 0.03 for part in parts)
    assert all(np.any(a != b) for a, b in itertools.pairwise(parts))


def test_largest_compliance_of_the_training_is_shown_at_first(plan):
    assert plan.alpha == 0.16


def test_strip_alone_needs_no_video_and_draws_its_frames_alone(plan):
    alone = dataclasses.replace(plan, out=None, gif=None)
    assert film.play(alone).count == 12


def _motion(force: np.ndarray, **other: np.ndarray) -> Motion:
    """One episode [T, 1] with forces [T, F, 3]."""
    steps = len(force)
    empty = dict.fromkeys(
        ("qpos", "u", "reference", "mocap_pos", "mocap_quat"), np.zeros((steps, 1))
    )
    return Motion(
        force_w=force[:, None], point_w=np.ones_like(force)[:, None], **empty | other
    )


def test_arrow_of_a_contact_between_the_frames_is_no_longer():
    force = np.zeros((12, 1, 3))
    force[4, 0, 0] = 250.0  # a frame later the ball is gone
    (frame,) = pictures.arrows(_motion(force), np.array([5]), np.array([0]))
    assert np.linalg.norm(frame[0][1]) == pytest.approx(pictures.LONGEST_ARROW)


def test_arrow_of_a_short_contact_fades_and_the_largest_is_the_longest():
    force = np.zeros((12, 1, 3))
    force[2, 0], force[6, 0] = [200.0, 0.0, 0.0], [0.0, 0.0, 400.0]
    frames = pictures.arrows(_motion(force), np.arange(12), np.zeros(12, int))
    lengths = [np.linalg.norm(vector) for ((_, vector),) in frames]
    echo, longest = pictures.ECHO, pictures.LONGEST_ARROW
    assert lengths[:2] == [0.0, 0.0]
    assert lengths[2:6] == pytest.approx(
        [0.5 * longest * (1.0 - age / echo) for age in range(4)]
    )
    assert lengths[6:12] == pytest.approx(
        [longest * (1.0 - age / echo) for age in range(6)]
    )
    point, vector = frames[7][0]
    np.testing.assert_array_equal(point, 1.0)
    assert vector[2] > 0.0 == vector[0]


def test_echo_of_a_force_ends_with_its_episode():
    force = np.zeros((6, 2, 1, 3))
    force[5, 0] = [100.0, 0.0, 0.0]
    empty = _motion(np.zeros((6, 1, 3)))
    motion = empty.replace(force_w=force, point_w=np.zeros_like(force))
    times, episodes = np.array([5, 0, 1]), np.array([0, 1, 1])
    (first,), (second,), (third,) = pictures.arrows(motion, times, episodes)
    assert np.linalg.norm(first[1]) == pytest.approx(pictures.LONGEST_ARROW)
    assert np.linalg.norm(second[1]) == np.linalg.norm(third[1]) == 0.0


def test_next_episode_begins_a_moment_after_a_fall():
    alive = np.arange(40)[:, None] < np.array([10, 40, 3])
    recording = SimpleNamespace(alive=alive, fell=np.array([True, False, True]))
    times, episodes = film._cut(recording, 60)
    after = film.AFTERMATH
    assert np.bincount(episodes).tolist() == [10 + after, 40, 10 - after]
    assert times[: 10 + after].tolist() == list(range(10 + after))
    assert times[10 + after] == 0


def test_sheet_fills_its_last_row_with_white():
    images = [np.full((2, 3, 3), level, np.uint8) for level in (10, 20, 30)]
    page = pictures.sheet(images, 2)
    assert page.shape == (4, 6, 3)
    assert page[0, 0, 0] == 10 and page[0, 3, 0] == 20 and page[2, 0, 0] == 30
    assert page[2, 3, 0] == 255


def test_ghost_is_the_pose_without_u():
    environment = make_environment(make_config("push", "smoke"))
    coords = environment.kinematics.coords
    rng = np.random.default_rng(0)
    q, u = (
        quat.exp_map(coords, jnp.array(0.3 * rng.normal(size=42), jnp.float32))
        for _ in range(2)
    )
    ball = np.arange(7.0)
    qpos = np.concatenate([quat.oplus(coords, q, u), ball])[None]
    ghost = displaced(environment, _motion(np.zeros((1, 1, 3)), qpos=qpos, u=u[None]))
    np.testing.assert_allclose(ghost[0, :55], q, atol=1e-5)
    np.testing.assert_array_equal(ghost[0, 55:], ball)


def test_slow_motion_goes_evenly_from_pose_to_pose_and_stops_between_episodes():
    environment = make_environment(make_config("push", "smoke"))
    model = environment.scene.model
    qpos = np.stack([model.qpos0] * 4)
    qpos[:, 0] = [0.0, 1.0, 5.0, 6.0]
    episodes = np.array([0, 0, 1, 1])
    at = pictures.moments(4, 2.0)
    found = pictures.between(model, qpos, episodes, at)
    np.testing.assert_allclose(at, np.arange(8) / 2)
    np.testing.assert_allclose(found[:, 0], [0.0, 0.5, 1.0, 1.0, 5.0, 5.5, 6.0, 6.0])
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:7], axis=1), 1.0)


def test_camera_takes_the_place_of_the_tasks_as_far_as_it_is_given():
    task = make_config("door", "smoke").task
    own = pictures.view_of(task)
    assert own.azimuth == task.camera_azimuth
    turned = pictures.view_of(task, (180.0, -30.0), still=True)
    assert (turned.azimuth, turned.elevation, turned.smooth) == (180.0, -30.0, 0.0)
    assert turned.distance == own.distance


def test_without_opengl_matplotlib_draws(plan, monkeypatch):
    monkeypatch.setattr(draw, "opengl_works", lambda: False)
    still = dataclasses.replace(plan, out=None, gif=None)
    images = list(film.play(still).images)
    assert len(images) == 12
    assert all(image.shape == (240, 320, 3) and image.std() > 5.0 for image in images)


@pytest.mark.parametrize(
    ("argv", "parts"),
    [
        ([], ["RUN_DIR"]),
        (["/none/here"], ["/none/here is not a run directory"]),
        (["{push}", "--out", "a.avi"], ["out must end in .mp4 or .gif, got a.avi"]),
        (["{push}", "--strip", "a.mp4"], ["strip must end in .png, got a.mp4"]),
        (["{push}", "--gif", "a.mp4"], ["gif must end in .gif, got a.mp4"]),
        (["{push}", "--slow", "0.5"], ["slow must be in [1, 16], got 0.5"]),
        (["{push}", "--camera", "0", "99"], ["camera must be", "[0.0, 99.0]"]),
        (["{push}", "--seconds", "0"], ["seconds must be in", "got 0.0"]),
        (["{push}", "--seconds", "nan"], ["seconds must be in", "got nan"]),
        (["{push}", "--alpha", "-1"], ["alpha must be in [0, 0.9], got -1.0"]),
        (["{push}", "--seed", "x"], ["--seed", "'x'"]),
        (["{push}", "--bogus"], ["--bogus"]),
    ],
)
def test_bad_input_is_one_line_and_status_two(argv, parts, push, capsys):
    assert command.main([part.format(push=push) for part in argv]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    for part in parts:
        assert part in line


def test_missing_video_extra_is_told_before_anything_is_played(
    push, monkeypatch, capsys
):
    def missing(path: object) -> None:
        raise ModuleNotFoundError("pip install 'dcc-jax[video]'")

    monkeypatch.setattr(files, "check_video", missing)
    assert command.main([str(push)]) == 2
    assert "pip install 'dcc-jax[video]'" in capsys.readouterr().err
