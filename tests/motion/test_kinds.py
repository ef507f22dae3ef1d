"""Kinds of files that other programs write, from clips whose every angle is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rewritten
from rewritten import Joint, Rig, far_off, imported, shipped
from scipy.spatial.transform import Rotation

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.frames import to_rotation
from dcc_jax.motion.retarget.retarget import Retargeted

WALK, RUN = shipped("walk", 60, 100), shipped("run", 100, 140)
NEAR = 0.5  # degrees
LIMBS = [3, 4, 5, 6, 7, 8, 10, 11]  # segments without trunk and feet


def same(result: Retargeted, truth: Clip, degrees: float = NEAR) -> None:
    angles, place = far_off(result.clip, truth)
    assert angles.max() < degrees
    assert place < 0.01 * degrees


def along_x() -> dict[str, Rotation]:
    """Axes of joints of which x is always along the bone, as game engines have them."""
    frames = {"Hips": Rotation.from_euler("y", -90.0, degrees=True)}
    for side, out in (("Left", 1.0), ("Right", -1.0)):
        frames[f"{side}Shoulder"] = Rotation.from_euler("z", 90.0 * out, degrees=True)
        frames[f"{side}UpLeg"] = Rotation.from_euler("y", 90.0, degrees=True)
        frames[f"{side}Foot"] = Rotation.from_euler("y", 25.0, degrees=True)
    return frames


def bent(elbow: float, knee: float) -> dict[str, Rotation]:
    """Axes of a zero pose with bent elbows and knees."""
    frames = {}
    for side, out in (("Left", 1.0), ("Right", -1.0)):
        frames[f"{side}ForeArm"] = Rotation.from_euler("z", elbow * out, degrees=True)
        frames[f"{side}UpLeg"] = Rotation.from_euler("y", knee / 2, degrees=True)
        frames[f"{side}Leg"] = Rotation.from_euler("y", -knee / 2, degrees=True)
        frames[f"{side}Foot"] = Rotation.identity()
    return frames


@pytest.mark.parametrize("truth", [WALK, RUN], ids=["walk", "run"])
@pytest.mark.parametrize(
    "frames",
    [
        {"Hips": Rotation.from_euler("z", 12.0, degrees=True)},
        {"Hips": Rotation.from_euler("z", -20.0, degrees=True)},
        bent(15.0, 16.0),
        bent(-18.0, -12.0),
    ],
    ids=["heading 12", "heading -20", "bent", "bent over"],
)
def test_a_zero_pose_may_be_turned_or_bent(tmp_path, frames, truth):
    text = Rig().posed(frames).text(truth)
    same(imported(tmp_path, text, clean=False), truth)


@pytest.mark.parametrize("axes", [rewritten.Y_UP, rewritten.Z_UP], ids=["y up", "z up"])
@pytest.mark.parametrize("truth", [WALK, RUN], ids=["walk", "run"])
def test_all_bones_may_lie_along_one_axis(tmp_path, truth, axes):
    text = replace(Rig(), axes=axes).posed(along_x()).text(truth)
    result = imported(tmp_path, text, clean=False)
    assert any("does not stand" in note for note in result.notes)
    angles, place = far_off(result.clip, truth)
    assert angles[:, :3].max() < 3.0 and angles[:, LIMBS].max() < 1.0
    assert place < 0.03


def test_position_channels_count_below_a_root_that_moves(tmp_path):
    """The root turns and shifts, and the hips have positions of their own."""
    rig = Rig()
    rig = replace(
        rig, joints=[Joint("Reference", "", (0.0, 0.0, 0.0), ""), *rig.joints]
    )
    rig = replace(
        rig,
        joints=[
            replace(j, parent="Reference", offset=(0.0, 0.0, 0.935))
            if j.name == "Hips"
            else j
            for j in rig.joints
        ],
        placed=frozenset(("Hips",)),
    )
    rows = rig.text(WALK).splitlines()
    same(imported(tmp_path, "\n".join(rows) + "\n", clean=False), WALK)
    start = next(k for k, row in enumerate(rows) if row.startswith("Frame Time")) + 1
    for k in range(start, len(rows)):
        values = rows[k].split()
        rows[k] = " ".join(["0", "0", "40.0", *values[3:]])
    turned = imported(tmp_path, "\n".join(rows) + "\n", clean=False)
    same(turned, WALK)


def without_positions(text: str) -> str:
    rows = text.replace("6 Xposition Yposition Zposition", "3").splitlines()
    start = next(k for k, row in enumerate(rows) if row.startswith("Frame Time")) + 1
    rows[start:] = [" ".join(row.split()[3:]) for row in rows[start:]]
    return "\n".join(rows) + "\n"


def test_without_travel_the_standing_foot_stays(tmp_path):
    result = imported(tmp_path, without_positions(Rig().text(WALK)))
    assert any("nothing of where the figure goes" in note for note in result.notes)
    assert any("from the feet" in doubt for doubt in result.doubts)
    way = np.linalg.norm(result.clip.qpos[-1, :2])
    assert way == pytest.approx(
        np.linalg.norm((WALK.qpos[-1] - WALK.qpos[0])[:2]), abs=0.03
    )


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0, 1000.0, 3.281, 11.96])
def test_legs_tell_the_unit(tmp_path, scale):
    same(imported(tmp_path, replace(Rig(), scale=scale).text(WALK), clean=False), WALK)


def test_a_given_unit_is_checked(tmp_path):
    text = Rig().text(WALK)
    same(imported(tmp_path, text, clean=False, unit="cm"), WALK)
    with pytest.raises(MotionError, match="80 m long with --unit m"):
        imported(tmp_path, text, unit="m")


def with_first(text: str, rows: list[str]) -> str:
    """The file with other rows before its own."""
    lines = text.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    count = len(lines) - at
    lines = [
        line.replace(f"Frames: {count}", f"Frames: {count + len(rows)}")
        for line in lines
    ]
    return "\n".join([*lines[:at], *rows, *lines[at:]]) + "\n"


@pytest.mark.parametrize("held", [1, 20])
@pytest.mark.parametrize("fall", [0.0, 45.0])
def test_a_rest_pose_before_the_motion_is_left_out(tmp_path, held, fall):
    arms = {
        f"{side}Arm": Rotation.from_euler("x", fall * out, degrees=True)
        for side, out in (("Left", 1.0), ("Right", -1.0))
    }
    text = Rig().posed(arms).text(WALK)
    first = text.splitlines()[-len(WALK.qpos)].split()
    rest = " ".join([*first[:3], *["0.0"] * (len(first) - 3)])
    result = imported(tmp_path, with_first(text, [rest] * held), clean=False)
    assert any("T-pose" in note for note in result.notes)
    same(result, WALK)


def test_a_motion_that_begins_fast_keeps_its_first_frame(tmp_path):
    for clip in (RUN, shipped("backflip", 40, 80), shipped("jump_high", 30, 70)):
        same(imported(tmp_path, Rig().text(clip), clean=False), clip)


@pytest.mark.parametrize(
    "seconds", ["0.033333", "0.0333", "0.03333333", "0.0333333333"]
)
def test_a_rounded_frame_time_loses_no_frame(tmp_path, seconds):
    text = Rig().text(WALK)
    line = next(row for row in text.splitlines() if row.startswith("Frame Time"))
    text = text.replace(line, f"Frame Time: {seconds}")
    same(imported(tmp_path, text, clean=False), WALK)


def test_a_frame_time_of_zero_is_overruled(tmp_path):
    text = Rig().text(WALK)
    line = next(row for row in text.splitlines() if row.startswith("Frame Time"))
    text = text.replace(line, "Frame Time: 0")
    with pytest.raises(MotionError, match="--source-fps"):
        imported(tmp_path, text)
    same(imported(tmp_path, text, clean=False, source_fps=30.0), WALK)


def test_rows_may_be_one_more_or_fewer_than_claimed(tmp_path):
    text = Rig().text(WALK)
    for claimed in (39, 41):
        told = text.replace("Frames: 40", f"Frames: {claimed}")
        result = imported(tmp_path, told, clean=False)
        assert any(f"claims {claimed}" in note for note in result.notes)
        same(result, WALK)


def test_a_last_row_that_is_cut_is_completed_or_left_out(tmp_path):
    text = Rig().text(WALK)
    nearly = imported(tmp_path, " ".join(text.split(" ")[:-4]) + "\n", clean=False)
    assert any("last row is cut" in note for note in nearly.notes)
    assert far_off(nearly.clip, WALK)[0][:, LIMBS].max() < NEAR
    barely = imported(tmp_path, " ".join(text.split(" ")[:-70]) + "\n", clean=False)
    same(barely, replace(WALK, qpos=WALK.qpos[:-1]))


def test_a_row_that_lacks_a_number_is_named(tmp_path):
    lines = Rig().text(WALK).splitlines()
    lines[-20] = lines[-20].rpartition(" ")[0]
    with pytest.raises(MotionError, match=rf":{len(lines) - 19}: a row of \d+ numbers"):
        imported(tmp_path, "\n".join(lines) + "\n")


def test_a_second_root_that_is_a_prop_is_left_out(tmp_path):
    prop = Joint("Stick", "", (0.0, 0.0, 0.0), "pelvis")
    rig = replace(Rig(), joints=[*rewritten.joints(), prop])
    result = imported(tmp_path, rig.text(WALK), clean=False)
    assert any("Stick" in note for note in result.notes)
    same(result, WALK)


def test_of_two_figures_one_has_to_be_named(tmp_path):
    other = [
        replace(j, name=f"B_{j.name}", parent=j.parent and f"B_{j.parent}")
        for j in rewritten.joints()
    ]
    rig = replace(Rig(), joints=[*rewritten.joints(), *other])
    rig = replace(rig, placed=frozenset(("Hips", "B_Hips")))
    with pytest.raises(MotionError, match=r"Hips, B_Hips.*--root"):
        imported(tmp_path, rig.text(WALK))
    same(imported(tmp_path, rig.text(WALK), clean=False, root="B_Hips"), WALK)


def test_names_of_leaves_may_occur_twice(tmp_path):
    same_names = {"LeftToe_End": "End", "RightToe_End": "End", "HeadTop_End": "End"}
    text = Rig().text(WALK)
    for name, twice in same_names.items():
        text = text.replace(f"JOINT {name}", f"JOINT {twice}")
    same(imported(tmp_path, text, clean=False), WALK)


def lying(frames: int = 40) -> Clip:
    """A figure that lies on its back, moves its arms a little and never stands."""
    clip = shipped("stand", 0, frames)
    qpos = clip.qpos.copy()
    qpos[:, :3] = [0.4, 0.2, 0.12]
    qpos[:, 0] += 0.01 * np.sin(np.arange(frames) / 5.0)
    qpos[:, 15:19] = WALK.qpos[:frames, 15:19]
    qpos[:, 3:7] = Rotation.from_euler("y", -90.0, degrees=True).as_quat(
        scalar_first=True
    )
    return replace(clip, qpos=qpos.astype(np.float32))


@pytest.mark.parametrize("axes", [rewritten.Y_UP, rewritten.Z_UP], ids=["y up", "z up"])
def test_who_lies_is_not_stood_upright(tmp_path, axes):
    text = replace(Rig(), axes=axes).text(lying())
    result = imported(tmp_path, text, clean=False)
    upward = to_rotation(result.clip.qpos[:, 3:7]).apply([0.0, 0.0, 1.0])
    assert np.abs(upward[:, 2]).max() < 0.05
    assert result.clip.qpos[:, 2].max() < 0.3
    assert any("never stands" in note for note in result.notes)


def test_trimming_leaves_up_where_it_is(tmp_path):
    down = lying()
    qpos = np.concatenate([WALK.qpos, down.qpos])
    text = Rig().text(replace(WALK, qpos=qpos))
    result = imported(tmp_path, text, clean=False, trim=(1.5, 2.5))
    assert result.clip.qpos[:, 2].max() < 0.3


def made_up(text: str, clip: Clip, seed: int) -> str:
    """The file with twists that its joint positions do not show.

    Every bone that has one child turns about itself at random, and the child back.
    """
    rng = np.random.default_rng(seed)
    frames = len(clip.qpos)
    smooth = np.cumsum(rng.normal(0.0, 12.0, (8, frames)), axis=1)
    lines = text.splitlines()
    order = [row.split()[-1] for row in lines if row.split()[0] in ("ROOT", "JOINT")]
    at = next(k for k, row in enumerate(lines) if row.startswith("Frame Time")) + 1
    values = np.array([row.split() for row in lines[at:]], float)
    chains = [
        (f"{side}{upper}", f"{side}{lower}", axis)
        for side in ("Left", "Right")
        for upper, lower, axis in (("UpLeg", "Leg", "y"), ("Arm", "ForeArm", "x"))
    ]
    for (upper, lower, axis), angle in zip(chains, smooth, strict=False):
        twist = Rotation.from_euler(axis, angle[:, None], degrees=True)
        for name, change in (
            (upper, lambda turn, twist=twist: turn * twist),
            (lower, lambda turn, twist=twist: twist.inv() * turn),
        ):
            column = 3 + 3 * order.index(name)
            turn = Rotation.from_euler(
                "ZXY", values[:, column : column + 3], degrees=True
            )
            values[:, column : column + 3] = change(turn).as_euler("ZXY", degrees=True)
    lines[at:] = [" ".join(f"{value:.6f}" for value in row) for row in values]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("seed", [0, 1])
def test_twists_that_the_positions_deny_are_not_taken(tmp_path, seed):
    result = imported(tmp_path, made_up(Rig().text(RUN), RUN, seed), clean=False)
    assert any("rotations and positions disagree" in note for note in result.notes)
    angles, _ = far_off(result.clip, RUN)
    assert angles[:, LIMBS].max() < 15.0
    assert angles[:, [0, 1]].max() < NEAR
