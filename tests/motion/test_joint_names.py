"""Joints of foreign skeletons: by names, place and lengths together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import rewritten
from rewritten import Joint, Rig, far_off, imported, shipped

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.retarget.words import read_names

WALK = shipped("walk", 60, 90)
OURS = {
    "UpLeg": "thigh",
    "Leg": "shin",
    "Foot": "foot",
    "Arm": "upper_arm",
    "ForeArm": "forearm",
}


def names(pattern: str, words: str, *, spine: str) -> dict[str, str]:
    """Names by a pattern with {side} and {part} for both sides, and those between.

    Args:
        pattern: such as `CC_Base_{side}_{part}`.
        words: side left, side right, then parts from thigh to toe and collar to hand.
        spine: hips, three of the spine, neck and head.
    """
    left, right, *parts = words.split()
    theirs = ["UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand"]
    sided = {
        f"{ours}{part}": pattern.format(side=side, part=word)
        for ours, side in (("Left", left), ("Right", right))
        for part, word in zip(theirs, parts, strict=True)
    }
    middle = ["Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"]
    return sided | dict(zip(middle, spine.split(), strict=True))


RIGS = {
    "Mixamo": names(
        "mixamorig:{side}{part}",
        "Left Right UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand",
        spine="mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2"
        " mixamorig:Neck mixamorig:Head",
    ),
    "100STYLE": names(
        "{side}{part}",
        "Left Right Hip Knee Ankle Toe Collar Shoulder Elbow Wrist",
        spine="Hips Chest Chest2 Chest3 Neck Head",
    ),
    "Bandai-Namco": names(
        "{part}_{side}",
        "L R UpperLeg LowerLeg Foot Toes Shoulder UpperArm LowerArm Hand",
        spine="Hips Spine Chest UpperChest Neck Head",
    ),
    "Xsens": names(
        "{side}{part}",
        "Left Right UpperLeg LowerLeg Foot Toe Shoulder UpperArm ForeArm Hand",
        spine="Pelvis L5 L3 T8 Neck Head",
    ),
    "Motive": names(
        "{side}{part}",
        "L R Thigh Shin Foot Toe Shoulder UArm FArm Hand",
        spine="Hip Ab Chest UpperChest Neck Head",
    ),
    "Rokoko": names(
        "{side}{part}",
        "Left Right Thigh Shin Foot Toe Shoulder Arm ForeArm Hand",
        spine="Hips Spine1 Spine2 Spine3 Neck Head",
    ),
    "SOMA": names(
        "{side}{part}",
        "Left Right Leg Shin Foot ToeBase Shoulder Arm ForeArm Hand",
        spine="Hips Spine1 Spine2 Chest Neck1 Head",
    ),
    "SMPL": names(
        "{side}_{part}",
        "L R Hip Knee Ankle Foot Collar Shoulder Elbow Wrist",
        spine="Pelvis Spine1 Spine2 Spine3 Neck Head",
    ),
    "Unreal": names(
        "{part}_{side}",
        "l r thigh calf foot ball clavicle upperarm lowerarm hand",
        spine="pelvis spine_01 spine_02 spine_03 neck_01 head",
    ),
    "VRM": names(
        "J_Bip_{side}_{part}",
        "L R UpperLeg LowerLeg Foot ToeBase Shoulder UpperArm LowerArm Hand",
        spine="J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest"
        " J_Bip_C_Neck J_Bip_C_Head",
    ),
    "Character Creator": names(
        "CC_Base_{side}_{part}",
        "L R Thigh Calf Foot ToeBase Clavicle Upperarm Forearm Hand",
        spine="CC_Base_Hip CC_Base_Waist CC_Base_Spine01 CC_Base_Spine02"
        " CC_Base_NeckTwist01 CC_Base_Head",
    ),
    "Daz": names(
        "{side}{part}",
        "l r ThighBend Shin Foot Toe Collar ShldrBend ForearmBend Hand",
        spine="hip abdomenLower chestLower chestUpper neckLower head",
    ),
    "Rigify": names(
        "{part}.{side}",
        "L R thigh shin foot toe shoulder upper_arm forearm hand",
        spine="spine spine.001 spine.002 spine.003 spine.004 spine.006",
    ),
    "Maya": names(
        "{side}_{part}_jnt",
        "l r upLeg loLeg foot ball clavicle upArm loArm hand",
        spine="root_jnt spineA_jnt spineB_jnt spineC_jnt neck_jnt head_jnt",
    ),
    "two words before": names(
        "Actor 07_{side}{part}",
        "Left Right UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand",
        spine="Actor_07_Hips Actor_07_Spine Actor_07_Spine1 Actor_07_Spine2"
        " Actor_07_Neck Actor_07_Head",
    ),
    "a word nobody lists": names(
        "{side}{part}",
        "Left Right UpLeg Leg Foot ToeBase Shoulder Quux Forearm Hand",
        spine="Hips Spine Spine1 Spine2 Neck Head",
    ),
}


@pytest.mark.parametrize("program", RIGS)
def test_joints_of_a_programs_rig_are_found(tmp_path, program):
    result = imported(tmp_path, Rig().renamed(RIGS[program]).text(WALK), clean=False)
    angles, place = far_off(result.clip, WALK)
    assert angles.max() < 0.5 and place < 0.005


def with_joints(rig: Rig, *more: Joint) -> Rig:
    return replace(rig, joints=[*rig.joints, *more])


def test_helper_joints_with_the_names_of_bones_are_not_taken(tmp_path):
    helpers = [
        Joint(f"{side[0]}_{name}", f"{side}{part}", (0.0, 0.0, 0.0), turns)
        for side in ("Left", "Right")
        for part, name in (("UpLeg", "Femur"), ("Leg", "Tibia"), ("Arm", "Humerus"))
        for turns in [f"{side.lower()}_{OURS[part]}"]
    ]
    result = imported(tmp_path, with_joints(Rig(), *helpers).text(WALK), clean=False)
    assert far_off(result.clip, WALK)[0].max() < 0.5


def between(rig: Rig, joint: str, name: str, turns: str) -> Rig:
    """A joint more, halfway to another one."""
    out = []
    for one in rig.joints:
        if one.name == joint:
            half = tuple(0.5 * x for x in one.offset)
            out.append(replace(one, name=name, offset=half, turns=turns))
            out.append(replace(one, parent=name, offset=half))
        else:
            out.append(one)
    return replace(rig, joints=out)


def test_a_still_joint_of_the_same_plain_name_is_not_taken(tmp_path):
    rig = Rig()
    for side in ("Left", "Right"):
        rig = between(rig, f"{side}UpLeg", f"__{side}UpLeg", "pelvis")
        rig = between(rig, f"{side}Arm", f"__{side}Arm", "chest")
    result = imported(tmp_path, rig.text(WALK), clean=False)
    assert far_off(result.clip, WALK)[0].max() < 0.5


def test_a_thigh_of_two_bones_turns_by_the_one_that_carries_the_knee(tmp_path):
    rig = Rig()
    for side in ("Left", "Right"):
        rig = between(rig, f"{side}Leg", f"{side}UpLegTwist", f"{side.lower()}_thigh")
    result = imported(tmp_path, rig.text(WALK), clean=False)
    assert far_off(result.clip, WALK)[0].max() < 0.5


def test_arms_that_hang_on_the_neck_leave_the_chest_to_the_spine(tmp_path):
    clip = shipped("walk", 60, 90)
    qpos = clip.qpos.copy()
    turn = np_quat_z(len(qpos))
    qpos[:, 11:15] = turn
    clip = replace(clip, qpos=qpos)
    shifted = [
        replace(j, parent="Neck", offset=(j.offset[0], j.offset[1], 0.0))
        if j.name.endswith("Shoulder")
        else replace(j, turns="head")
        if j.name == "Neck"
        else j
        for j in Rig().joints
    ]
    result = imported(tmp_path, replace(Rig(), joints=shifted).text(clip), clean=False)
    assert far_off(result.clip, clip)[0][:, :2].max() < 0.5


def np_quat_z(frames: int):
    """Quaternions [T, 4] of a head that turns by 40 degrees."""
    import numpy as np

    half = 0.5 * np.radians(40.0) * np.sin(np.linspace(0.0, 3.0, frames))
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)


def test_two_legs_that_fit_as_well_are_refused(tmp_path):
    """A second leg on the same hip: nobody can tell which one is meant."""
    rig = Rig()
    twins = [
        replace(
            j,
            name=f"{j.name}_b",
            parent=f"{j.parent}_b" if j.parent != "Hips" else "Hips",
            offset=(j.offset[0], j.offset[1] * 1.5, j.offset[2]),
        )
        for j in rig.joints
        if any(part in j.name for part in ("LeftUpLeg", "LeftLeg", "LeftFoot"))
    ]
    with pytest.raises(MotionError, match=r"cannot tell .*left_thigh.*--map"):
        imported(tmp_path, with_joints(rig, *twins).text(WALK))


def test_sides_that_are_swapped_or_mirrored_are_refused_or_mended(tmp_path):
    swapped = {
        j.name: j.name.replace(*words)
        for j in rewritten.joints()
        for words in [("Left", "Right") if "Left" in j.name else ("Right", "Left")]
    }
    text = Rig().renamed(swapped).text(WALK)
    with pytest.raises(MotionError, match=r"--sides swap"):
        imported(tmp_path, text)
    result = imported(tmp_path, text, sides="swap", clean=False)
    assert far_off(result.clip, WALK)[0].max() < 0.5


def test_a_name_says_its_side_and_part():
    for name, side, part in (
        ("mixamorig:LeftUpLeg", "left", "thigh"),
        ("lfemur", "left", "thigh"),
        ("rShldrBend", "right", "upper_arm"),
        ("RFArm", "right", "forearm"),
        ("thigh.L", "left", "thigh"),
        ("Bip01 R Calf", "right", "shin"),
    ):
        [named] = read_names([name])
        assert named.side == side and max(named.parts, key=named.score) == part
    assert read_names(["LeftHandThumb1"])[0].aside
