"""What the package writes, however another program would, it reads back."""

from __future__ import annotations

import numpy as np
import pytest
import rewritten
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rewritten import Rig, far_off, imported, shipped
from scipy.spatial.transform import Rotation

from dcc_jax.character import asset_path
from dcc_jax.motion.clip import Clip
from dcc_jax.motion.frames import rotations, to_rotation
from dcc_jax.motion.retarget.bvh_writer import bvh_text
from dcc_jax.motion.retarget.retarget import finish, placed

CLIPS = sorted(path.stem for path in asset_path("motions").glob("*.npz"))
ANGLE, PLACE = 0.5, 0.005  # degrees, m
EXACT_ANGLE, EXACT_PLACE = 0.1, 0.001
KNEES = (7, 10)  # of the joints


def down(side: str, degrees: float) -> Rotation:
    """Axes of an arm whose zero pose hangs so far below a T-pose."""
    return Rotation.from_euler(
        "x", degrees if side == "Left" else -degrees, degrees=True
    )


def arms(degrees: float) -> dict[str, Rotation]:
    return {f"{side}Arm": down(side, degrees) for side in ("Left", "Right")}


RIGS = st.builds(
    lambda order, scale, axes, fall, prefix: Rig(
        order=order, scale=scale, axes=axes, prefix=prefix
    ).posed(arms(fall)),
    st.sampled_from(["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]),
    st.sampled_from([1.0, 100.0, 1.0 / 0.0254]),
    st.sampled_from([rewritten.Y_UP, rewritten.Z_UP, rewritten.X_UP]),
    st.sampled_from([0.0, 45.0, 80.0]),
    st.sampled_from(["", "mixamorig:", "Character1_", "Actor 07_", "Bip01 "]),
)
ONE_PROCESS = {
    "deadline": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
}


def reads_back(folder, name: str, rig: Rig) -> None:
    clip = shipped(name)
    ours = imported(folder, rig.text(clip), clean=False).clip
    angles, place = far_off(ours, clip)
    assert angles.max() < ANGLE
    assert place < PLACE


@settings(max_examples=12, **ONE_PROCESS)
@given(name=st.sampled_from(CLIPS), rig=RIGS)
def test_a_clip_comes_back_whatever_the_rig(tmp_path, name, rig):
    reads_back(tmp_path, name, rig)


@pytest.mark.slow
@settings(max_examples=400, **ONE_PROCESS)
@given(name=st.sampled_from(CLIPS), rig=RIGS)
def test_every_clip_comes_back_whatever_the_rig(tmp_path, name, rig):
    reads_back(tmp_path, name, rig)


@pytest.mark.parametrize("name", ["walk", "backflip", "hop", "run_cycle"])
def test_an_exported_clip_is_read_back(tmp_path, name):
    clip = shipped(name)
    angles, place = far_off(imported(tmp_path, bvh_text(clip), clean=False).clip, clip)
    assert angles.max() < EXACT_ANGLE
    assert place < EXACT_PLACE


def knee_bends(clip: Clip) -> np.ndarray:
    """Largest second difference of each knee, degrees."""
    angle = np.degrees(rotations(clip.qpos).magnitude()[:, [1 + k for k in KNEES]])
    return np.abs(np.diff(angle, 2, axis=0)).max(axis=0)


@pytest.mark.parametrize("name", CLIPS)
def test_cleaning_leaves_our_own_clips_as_they_are(name):
    clip = shipped(name)
    cleaned = finish(clip, clip.fps, True).clip
    before = to_rotation(placed(clip).qpos[:, 7:].reshape(-1, 12, 4))
    after = to_rotation(cleaned.qpos[:, 7:].reshape(-1, 12, 4))
    assert np.degrees((before.inv() * after).magnitude()).max() < 3.0
    assert (knee_bends(cleaned) <= 1.2 * knee_bends(clip) + 0.05).all()
