"""Clips: the format on disk and the operations on whole motions."""

import io
import math
import subprocess
import sys
import zipfile
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcc_jax.character import compose_scene, load_character
from dcc_jax.motion import clip as clips
from dcc_jax.motion.clip import Clip, MotionError, load_clip, save_clip
from dcc_jax.motion.frames import join_qpos, rotations


def wave(frames=61, fps=30.0, turn=0.0, **fields) -> Clip:
    """A periodic motion of every joint that walks ahead and turns by `turn`."""
    t = np.linspace(0.0, 1.0, frames)
    axes = np.random.default_rng(0).normal(size=(13, 3))
    swing = np.sin(2.0 * np.pi * t + np.arange(13)[:, None]).T
    local = Rotation.from_rotvec(0.4 * swing[..., None] * axes)
    yaw = Rotation.from_rotvec(np.outer(turn * t, [0.0, 0.0, 1.0]))
    quats = local.as_quat(scalar_first=True)
    root = yaw * Rotation.from_quat(quats[:, 0], scalar_first=True)
    quats[:, 0] = root.as_quat(scalar_first=True)
    position = np.stack([1.2 * t, 0 * t, 0.9 + 0.02 * np.cos(2 * np.pi * t)], 1)
    return Clip(join_qpos(position, quats), fps, "wave", **fields)


def test_a_clip_survives_the_disk(tmp_path):
    clip = wave(
        loop=True,
        label="walk",
        source="here",
        licence="CC0",
        phase=np.linspace(0, 1, 61, dtype=np.float32),
    )
    save_clip(tmp_path / "a.npz", clip)
    read = load_clip(tmp_path / "a.npz")
    for field in ("qpos", "phase"):
        np.testing.assert_array_equal(getattr(read, field), getattr(clip, field))
    for field in ("fps", "name", "source", "licence", "loop", "label"):
        assert getattr(read, field) == getattr(clip, field)


def test_equal_clips_give_equal_bytes_and_leave_no_other_file(tmp_path):
    save_clip(tmp_path / "a.npz", wave())
    save_clip(tmp_path / "b.npz", wave())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {i.date_time[0] for i in archive.infolist()} == {1980}


def spoiled(**changes) -> Clip:
    """The wave with one field or one stretch of qpos changed."""
    clip = wave()
    for key, value in changes.items():
        clip = replace(clip, **{key: value(clip) if callable(value) else value})
    return clip


def _edit(frame, column, value):
    def edit(clip):
        qpos = clip.qpos.copy()
        qpos[frame, column] = value
        return qpos

    return edit


def _flip(clip):
    qpos = clip.qpos.copy()
    qpos[7:, 11:15] *= -1.0
    return qpos


@pytest.mark.parametrize(
    ("clip", "reason"),
    [
        (
            spoiled(qpos=_edit(5, 2, np.nan)),
            "frame 5 holds a number that is not finite",
        ),
        (spoiled(qpos=_edit(6, 7, 3.0)), "frame 6 has a quaternion"),
        (spoiled(qpos=_flip), "changes its sign at frame 6"),
        (spoiled(qpos=lambda c: c.qpos[:, :54]), "not [T, 55]"),
        (spoiled(qpos=lambda c: c.qpos.astype(float)), "not float32"),
        (spoiled(qpos=lambda c: c.qpos[:1]), "needs 2 frames"),
        (spoiled(fps=0.0), "fps is 0.0"),
        (spoiled(fps=math.nan), "fps is nan"),
        (spoiled(phase=np.zeros(3, np.float32)), "one value a frame"),
        (spoiled(phase=np.full(61, 2, np.float32)), "phase is not in"),
        (spoiled(qpos=lambda c: c.qpos[:40], loop=True), "marked as a loop"),
    ],
)
def test_an_invalid_clip_is_neither_saved_nor_loaded(
    tmp_path, monkeypatch, clip, reason
):
    path = tmp_path / "bad.npz"
    with pytest.raises(MotionError) as saving:
        save_clip(path, clip)
    assert reason in str(saving.value) and "\n" not in str(saving.value)
    assert not list(tmp_path.iterdir())
    with monkeypatch.context() as unchecked:
        unchecked.setattr(clips, "validate", lambda clip, path: None)
        save_clip(path, clip)
    with pytest.raises(MotionError, match=r"bad\.npz: "):
        load_clip(path)


def test_pickles_and_lies_in_an_archive_are_refused(tmp_path):
    path = tmp_path / "evil.npz"
    np.savez(path, qpos=np.array([print], dtype=object))
    with pytest.raises(MotionError, match="pickled objects"):
        load_clip(path)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"shape": (10**9, 55), "fortran_order": False, "descr": "<f4"}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("qpos.npy", header.getvalue())
    with pytest.raises(MotionError, match="claims 220000000000 bytes but holds 0"):
        load_clip(path)


def test_every_truncation_and_every_flipped_byte_is_noticed(tmp_path):
    save_clip(tmp_path / "a.npz", wave(frames=4))
    data = (tmp_path / "a.npz").read_bytes()
    path = tmp_path / "cut.npz"
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(MotionError):
            load_clip(path)


def test_a_missing_file_is_named():
    with pytest.raises(
        MotionError, match=r"no/such\.npz: cannot be read: No such file"
    ):
        load_clip("no/such.npz")


def test_velocities_are_what_mujoco_calls_qvel():
    clip = wave(frames=601, fps=600.0)
    model = compose_scene(load_character())
    speed = clips.velocities(clip)
    assert speed.shape == (601, 42)
    expected = np.zeros(42)
    for frame in (100, 300):
        before, after = clip.qpos[frame - 1], clip.qpos[frame + 1]
        mujoco.mj_differentiatePos(model, expected, 2.0 / 600.0, before, after)
        np.testing.assert_allclose(speed[frame], expected, atol=2e-3)


def test_a_loop_has_the_same_velocities_at_both_ends():
    clip = wave(frames=301, fps=300.0, turn=0.7, loop=True)
    first, last = clips.velocities(clip)[[0, -1]]
    turn, shift = clips.seam(clip)
    assert turn == pytest.approx(0.7, abs=1e-5)
    np.testing.assert_allclose(shift, [1.2, 0.0], atol=1e-5)
    np.testing.assert_allclose(last[3:], first[3:], atol=1e-3)
    rotated = Rotation.from_euler("z", turn).apply(first[:3])
    np.testing.assert_allclose(last[:3], rotated, atol=1e-3)


def test_resampling_follows_the_motion():
    clip = clips.resample(wave(frames=601, fps=600.0, loop=True), 30.0)
    assert len(clip.qpos) == 31 and clip.fps == 30.0 and clip.loop
    angle = rotations(clip.qpos).inv() * rotations(wave(frames=31).qpos)
    assert angle.magnitude().max() < 1e-3


def test_a_loop_stays_a_loop_at_a_rate_that_does_not_divide_it():
    clip = clips.resample(wave(frames=110, fps=100.0, loop=True, turn=0.3), 30.0)
    assert len(clip.qpos) == 34
    clips.validate(clip, "memory")
    assert len(clips.resample(wave(frames=110, fps=100.0), 30.0).qpos) == 33


@pytest.mark.parametrize("loop", [True, False])
def test_low_pass_removes_noise_and_keeps_the_motion(loop):
    truth = wave(frames=121, fps=120.0, loop=loop)
    noise = 0.004 * np.random.default_rng(1).normal(size=truth.qpos.shape)
    noise[[0, -1]] = 0.0
    noisy = replace(truth, qpos=(truth.qpos + noise).astype(np.float32))
    smooth = clips.low_pass(noisy, 8.0)
    clips.validate(smooth, "memory")
    inner = slice(12, -12)
    error = np.abs(smooth.qpos - truth.qpos)[inner].mean()
    assert error < 0.45 * np.abs(noisy.qpos - truth.qpos)[inner].mean()
    assert np.abs(smooth.qpos - truth.qpos).max() < 0.01


def test_the_mirror_image_has_mirrored_bodies():
    clip = wave()
    model = compose_scene(load_character())
    data, twin = mujoco.MjData(model), mujoco.MjData(model)
    data.qpos, twin.qpos = clip.qpos[13], clips.mirrored(clip).qpos[13]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_kinematics(model, twin)
    for body in range(1, model.nbody):
        name = model.body(body).name
        other = name.replace("left", "?").replace("right", "left").replace("?", "right")
        np.testing.assert_allclose(
            data.xpos[body] * [1, -1, 1], twin.body(other).xpos, atol=1e-5
        )
    np.testing.assert_allclose(
        clips.mirrored(clips.mirrored(clip)).qpos, clip.qpos, atol=1e-6
    )


def test_crop_cuts_at_the_nearest_frames():
    clip = clips.crop(wave(loop=True), 0.5, 1.0)
    np.testing.assert_allclose(clip.qpos[:, :3], wave().qpos[15:31, :3])
    assert not clip.loop
    with pytest.raises(ValueError, match="not within 0 to"):
        clips.crop(clip, 0.2, 9.0)


def test_reading_clips_needs_no_jax():
    code = "import sys, dcc_jax.motion.clip; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
