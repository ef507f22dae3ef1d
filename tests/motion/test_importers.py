"""Importers: real files against known positions, and files nobody has seen."""

import time
from dataclasses import replace
from pathlib import Path

import motion_files as files
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcc_jax.motion.formats import asf_amc
from dcc_jax.motion.formats.bvh import read_bvh
from dcc_jax.motion.formats.deepmimic import read_deepmimic
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import CMU_UNIT, Motion
from dcc_jax.motion.frames import to_rotation
from dcc_jax.motion.retarget import retarget
from dcc_jax.motion.retarget.anatomy import Anatomy
from dcc_jax.motion.retarget.figure import figure, world_of
from dcc_jax.motion.retarget.importer import Options, import_motion, read_motion
from dcc_jax.motion.retarget.lead_in import without_rest_pose
from dcc_jax.motion.retarget.match import match

real = pytest.mark.skipif(not files.MOTIONS.is_dir(), reason="no motion data here")
CMU, HDM = files.MOTIONS / "cmu_asfamc", files.MOTIONS / "hdm05_asfamc"
MILLIMETRE = 1e-3


def cmu(name: str) -> Motion:
    return read_motion(CMU / f"{name}.amc", Options(), ())


def check(motion: Motion, frame: int, wanted: dict[str, tuple], unit: float) -> None:
    """Positions in the file's axes to a millimetre."""
    positions = unit * motion.positions()[frame]
    for name, position in wanted.items():
        actual = positions[motion.names.index(name)]
        np.testing.assert_allclose(actual, position, atol=MILLIMETRE, err_msg=name)


@real
def test_a_cmu_amc_has_the_known_positions():
    motion = cmu("01_01")
    assert motion.root.shape == (2751, 3) and motion.unit == pytest.approx(CMU_UNIT)
    wanted = {
        "root": (0.5301, 0.8216, -1.0073),
        "ltibia": (0.6628, 0.3931, -0.7391),
        "lfoot": (0.6515, 0.1103, -1.0532),
        "ltoes_end": (0.6699, 0.0727, -0.8593),
        "lowerneck": (0.5287, 1.0778, -0.7740),
        "head_end": (0.5144, 1.3556, -0.7001),
    }
    check(motion, 200, wanted, CMU_UNIT)
    for name, xyzw in (
        ("root", (0.13626, -0.01670, -0.04416, 0.98955)),
        ("lfemur", (-0.33322, -0.01367, -0.09227, 0.93822)),
    ):
        turn = to_rotation(motion.quats[200, motion.names.index(name)])
        assert (turn.inv() * Rotation.from_quat(xyzw)).magnitude() < 1e-4


@real
def test_another_cmu_amc_has_the_known_positions():
    wanted = {
        "root": (0.5881, 0.9429, -1.6990),
        "ltibia": (0.6070, 0.4719, -1.4304),
        "rtoes_end": (0.6021, -0.0031, -1.7507),
        "head_end": (0.5675, 1.5574, -1.6877),
    }
    check(cmu("02_01"), 0, wanted, CMU_UNIT)


@real
def test_a_bvh_with_a_t_pose_first_has_the_known_positions():
    motion = read_bvh(files.MOTIONS / "cmu_bvh" / "01_01.bvh")
    motion = without_rest_pose(Anatomy(motion, match(motion)[0]))
    assert len(motion.root) == 2751 and "T-pose" in motion.notes[0]
    wanted = {
        "Hips": (0.5301, 0.8216, -1.0073),
        "LeftLeg": (0.6628, 0.3931, -0.7391),
        "LeftFoot": (0.6515, 0.1103, -1.0532),
        "LeftToeBase_end": (0.6699, 0.0727, -0.8593),
        "Head_end": (0.5214, 1.2677, -0.7763),
    }
    check(motion, 200, wanted, CMU_UNIT)


@real
def test_a_bvh_with_mixed_orders_has_the_known_positions():
    wanted = {
        "Hips": (0.2919, 0.9560, -1.6440),
        "LeftAnkle": (0.3229, 0.0887, -1.6739),
        "RightWrist": (0.1431, 0.8263, -1.6065),
    }
    motion = read_bvh(files.MOTIONS / "cmu_bvh" / "131_03_3dsmax.bvh")
    check(motion, 0, wanted, CMU_UNIT)


@real
def test_a_bvh_with_a_placed_root_has_the_known_positions():
    wanted = {
        "Character1_Hips": (-0.3051, 1.0452, -2.3741),
        "Character1_LeftFoot": (-0.2464, 0.1535, -2.2881),
        "Character1_RightHand": (-0.6686, 0.8984, -2.3216),
    }
    check(read_bvh(files.MOTIONS / "mass_bvh" / "walk.bvh"), 0, wanted, 0.01)


@real
def test_a_deepmimic_clip_has_the_known_positions():
    wanted = {
        "head": (0.0472, 1.3048, 0.0173),
        "left_foot": (-0.3474, 0.1139, -0.0351),
        "right_foot": (0.2411, 0.0577, 0.0364),
        "right_hand": (-0.1382, 0.8102, 0.2374),
    }
    motion = read_deepmimic(files.MOTIONS / "deepmimic" / "humanoid3d_walk.txt")
    check(motion, 0, wanted, 1.0)


@pytest.fixture(scope="session")
def long_amc():
    """CMU 01_01 imported, and how long that took in s of processor time."""
    before = time.process_time()
    result = import_motion(CMU / "01_01.amc", Options())
    return result.clip, time.process_time() - before


@real
@pytest.mark.slow  # it times: for a machine that is not loaded
def test_23_seconds_of_amc_import_in_10(long_amc):
    clip, seconds = long_amc
    assert clip.duration == pytest.approx(22.9, abs=0.1)
    assert seconds < 10.0


def joints(clip) -> np.ndarray:
    return figure().positions(clip.qpos[:, :3].astype(float), world_of(clip.qpos))


@real
def test_amc_and_bvh_of_one_trial_give_the_same_clip(long_amc):
    one = long_amc[0]
    other = import_motion(files.MOTIONS / "cmu_bvh" / "01_01.bvh", Options()).clip
    apart = to_rotation(world_of(one.qpos)).inv() * to_rotation(world_of(other.qpos))
    assert np.degrees(apart.magnitude()).max() < 1.0
    assert np.linalg.norm(joints(one) - joints(other), axis=-1).max() < 0.01


@real
def test_the_poselib_hop_is_a_part_of_the_cmu_trial():
    path = files.MOTIONS / "amp_poselib_npz" / "amp_humanoid_hop.npz"
    hop = import_motion(path, Options(fps=60.0)).clip
    part = Options(fps=60.0, trim=(149.0 / 120.0, 742.0 / 120.0))
    twin = import_motion(CMU / "01_01.amc", part).clip
    frames = min(len(hop.qpos), len(twin.qpos))
    assert abs(len(hop.qpos) - len(twin.qpos)) <= 1
    apart = joints(hop)[:frames] - joints(twin)[:frames]
    assert np.linalg.norm(apart - apart.mean(axis=(0, 1)), axis=-1).mean() < 0.03


WALKS_AND_RUNS = (
    "cmu_asfamc/02_01.amc",
    "cmu_asfamc/02_02.amc",
    "cmu_asfamc/02_03.amc",
    "cmu_asfamc/07_05.amc",
    "mass_bvh/walk.bvh",
    "mass_bvh/run.bvh",
    "deepmimic/humanoid3d_walk.txt",
    "deepmimic/humanoid3d_jog.txt",
    "deepmimic/humanoid3d_run.txt",
    "amp_poselib_npz/amp_humanoid_walk.npz",
    "amp_poselib_npz/amp_humanoid_run.npz",
)


@real
@pytest.mark.parametrize("name", WALKS_AND_RUNS)
def test_feet_of_walks_and_runs_neither_slide_nor_sink(name):
    result = import_motion(files.MOTIONS / name, Options())
    assert result.after.skate < 3.0
    assert result.after.penetration < 1.0
    assert result.after.skate < 0.5 * result.before.skate
    assert result.after.root_jerk < 1.1 * result.before.root_jerk
    assert result.pose_error < 3.0
    assert result.after.standing > 0.2


@real
@pytest.mark.parametrize("subject", ["02_02", "07_05"])
def test_a_rising_floor_is_levelled(subject):
    assert import_motion(CMU / f"{subject}.amc", Options()).slope == pytest.approx(
        0.018, abs=0.003
    )


@real
@pytest.mark.parametrize(
    "path",
    [
        *sorted(HDM.glob("*.amc")),
        CMU / "02_04.amc",
        CMU / "16_09.amc",
        CMU / "131_04.amc",
        files.MOTIONS / "cmu_bvh" / "131_03_3dsmax.bvh",
        files.MOTIONS / "mass_bvh" / "backflip.bvh",
        files.MOTIONS / "mass_bvh" / "balance.bvh",
        files.MOTIONS / "deepmimic" / "humanoid3d_backflip.txt",
        files.MOTIONS / "deepmimic" / "humanoid3d_jump.txt",
        files.MOTIONS / "deepmimic" / "humanoid3d_sideflip.txt",
    ],
    ids=lambda path: path.stem,
)
def test_every_other_file_imports_without_options(path):
    result = import_motion(path, Options())
    assert result.after.penetration < 1.0
    assert result.pose_error < 5.0


def imported(tmp_path: Path, text: str, **options):
    path = tmp_path / "stranger.bvh"
    path.write_bytes(text.encode("latin-1"))
    return import_motion(path, Options(low_pass=0.0, **options))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return imported(tmp_path_factory.mktemp("plain"), files.bvh()).clip


@pytest.mark.parametrize(
    "changes",
    [
        {"scale": 1.0},
        {"scale": 1.0 / 0.0254},
        {"scale": 1000.0},
        {"axes": files.Z_UP},
        {"axes": files.Z_UP, "scale": 1.0, "order": "XYZ"},
        {"order": "YXZ", "prefix": ""},
        {"prefix": "Character1_", "newline": "\r\n"},
        {"prefix": "Bip01 "},
    ],
    ids=str,
)
def test_the_exporter_does_not_matter(tmp_path, plain, changes):
    clip = imported(tmp_path, files.bvh(**changes)).clip
    apart = to_rotation(world_of(clip.qpos)).inv() * to_rotation(world_of(plain.qpos))
    assert np.degrees(apart.magnitude()).max() < 0.1
    assert np.linalg.norm(joints(clip) - joints(plain), axis=-1).max() < 1e-3


def test_a_foot_that_hangs_on_an_ankle_is_where_the_toes_begin(tmp_path, plain):
    """As in SMPL: hip, knee, ankle, foot."""
    text = files.bvh(prefix="")
    for ours, theirs in (("ToeBase", "_Foot"), ("Foot", "_Ankle"), ("UpLeg", "_Hip")):
        text = text.replace(f"Left{ours}\n", f"L{theirs}\n")
        text = text.replace(f"Right{ours}\n", f"R{theirs}\n")
    text = text.replace("LeftLeg\n", "L_Knee\n").replace("RightLeg\n", "R_Knee\n")
    result = imported(tmp_path, text)
    assert any("left_foot=L_Ankle" in note for note in result.notes)
    assert np.linalg.norm(joints(result.clip) - joints(plain), axis=-1).max() < 1e-3


def test_cleaning_that_makes_another_pose_of_it_is_not_used(tmp_path, monkeypatch):
    """A crawl's upright feet, taken for stances, bent every leg by 120 degrees."""

    def spoil(clip, standing, left):
        return replace(clip, qpos=np.roll(clip.qpos, len(clip.qpos) // 4, axis=0))

    copy = imported(tmp_path, files.bvh(), clean=False)
    monkeypatch.setattr(retarget, "clean_feet", spoil)
    monkeypatch.setattr(retarget, "WORST_POSE", 3.0)
    result = imported(tmp_path, files.bvh())
    assert any("feet left as they are" in note for note in result.notes)
    np.testing.assert_array_equal(result.clip.qpos, copy.clip.qpos)


def test_the_march_is_what_was_written(plain):
    """The left knee comes up first, by the hip's 0.9 rad, and the feet come to rest."""
    turn = to_rotation(plain.qpos[:, 31:35])
    thigh = turn.as_rotvec()[:, 1]
    assert thigh[:15].argmin() in range(5, 11)
    assert thigh.min() == pytest.approx(-0.9, abs=0.12)
    assert np.abs(plain.qpos[0, :2]).max() < 1e-6


def test_a_world_up_that_differs_from_the_zero_pose_is_found(tmp_path, plain):
    """Some exporters keep a y-up zero pose and turn the root until z is up."""
    rows = files.bvh(order="XYZ").splitlines()
    start = next(k for k, row in enumerate(rows) if row.startswith("Frame Time")) + 1
    tilt = Rotation.from_euler("X", 90.0, degrees=True)
    for k in range(start, len(rows)):
        values = np.array(rows[k].split(), float)
        root = tilt * Rotation.from_euler("XYZ", values[3:6], degrees=True)
        values[:3] = tilt.apply(values[:3])
        values[3:6] = root.as_euler("XYZ", degrees=True)
        rows[k] = " ".join(f"{value:.6f}" for value in values)
    text = "\n".join(rows) + "\n"
    for options in ({}, {"up": "z"}):
        result = imported(tmp_path, text, **options)
        assert any("up is z" in note for note in result.notes)
        assert np.linalg.norm(joints(result.clip) - joints(plain), axis=-1).max() < 1e-3


def test_a_joint_with_an_odd_name_is_found_by_its_place(tmp_path, plain):
    text = files.bvh(prefix="").replace("LeftLeg", "Bone07").replace("Head", "Box")
    result = imported(tmp_path, text)
    assert any("left_shin=Bone07" in n and "head=Box" in n for n in result.notes)
    assert "joints were told by their place" in result.doubts
    assert np.abs(result.clip.qpos - plain.qpos).max() < 1e-3


def test_odd_names_import_with_a_map_and_are_refused_without(tmp_path, plain):
    text = files.bvh(prefix="").replace("LeftLeg", "Bone07").replace("UpLeg", "Bone08")
    with pytest.raises(MotionError, match=r"left_thigh, left_shin.*Bone07.*--map"):
        imported(tmp_path, text)
    names = {"left_shin": "Bone07", "left_thigh": "LeftBone08"}
    names["right_thigh"] = "RightBone08"
    clip = imported(tmp_path, text, names=names).clip
    assert np.abs(clip.qpos - plain.qpos).max() < 1e-3


def test_a_pose_of_the_motion_can_stand_in_for_a_crooked_zero_pose(tmp_path, plain):
    """All legs point ahead in the zero pose; the hips turn them down in every frame."""
    text = files.bvh(prefix="", order="XYZ")
    for drop in ("44", "42"):
        straight = f"OFFSET 0.000000 -{drop}.000000 0.000000"
        assert text.count(straight) == 2
        text = text.replace(straight, f"OFFSET 0.000000 0.000000 {drop}.000000")
    toe = "OFFSET 0.000000 -7.000000 13.000000"
    assert text.count(toe) == 2
    text = text.replace(toe, "OFFSET 0.000000 13.000000 7.000000")
    rows = text.splitlines()
    start = next(k for k, row in enumerate(rows) if row.startswith("Frame Time")) + 1
    order = [row.split()[-1] for row in rows if row.split()[0] in ("ROOT", "JOINT")]
    down = Rotation.from_euler("X", 90.0, degrees=True)
    for k in range(start, len(rows)):
        values = np.array(rows[k].split(), float)
        for name, change in (
            ("UpLeg", lambda turn: turn * down),
            ("Leg", lambda turn: down.inv() * turn * down),
            ("Foot", lambda turn: down.inv() * turn * down),
        ):
            for side in ("Left", "Right"):
                at = 3 + 3 * order.index(side + name)
                turn = Rotation.from_euler("XYZ", values[at : at + 3], degrees=True)
                values[at : at + 3] = change(turn).as_euler("XYZ", degrees=True)
        rows[k] = " ".join(f"{value:.6f}" for value in values)
    text = "\n".join(rows) + "\n"
    # Of feet that never leave the ground the motion tells no more than this.
    told = imported(tmp_path, text).clip
    apart = to_rotation(told.qpos[:, 3:7]).inv() * to_rotation(plain.qpos[:, 3:7])
    assert np.degrees(apart.magnitude()).max() < 5.0
    clip = imported(tmp_path, text, rest_frame=0).clip
    # Frame 0 hangs its arms in front; only the legs are like those of the T-pose.
    for column in range(31, 55):
        np.testing.assert_allclose(
            clip.qpos[:, column], plain.qpos[:, column], atol=2e-3
        )


def write_amc(folder: Path, **options) -> Path:
    (folder / "07.asf").write_text(files.asf())
    (folder / "07_05.amc").write_text(files.amc(**options))
    return folder / "07_05.amc"


def test_a_synthetic_amc_crouches_with_flat_feet(tmp_path):
    result = import_motion(write_amc(tmp_path), Options())
    assert any("07.asf" in note for note in result.notes)
    assert any("120 fps" in note for note in result.notes)
    knee = to_rotation(result.clip.qpos[:, 35:39]).as_rotvec()[:, 1]
    assert np.degrees(knee.max()) == pytest.approx(80.0, abs=4.0)
    assert result.after.penetration < 0.3
    foot = to_rotation(world_of(result.clip.qpos)[:, 9]).apply([0.0, 0.0, 1.0])
    assert foot[:, 2].min() > 0.998


def test_a_missing_thumb_rests_but_a_missing_knee_is_an_error(tmp_path):
    notes = import_motion(write_amc(tmp_path, skip=("lthumb",)), Options()).notes
    assert any("lthumb is missing" in note for note in notes)
    with pytest.raises(
        MotionError, match=r"07_05\.amc:\d+: frame 1 lacks bone 'ltibia'"
    ):
        import_motion(write_amc(tmp_path, skip=("ltibia",)), Options())


def test_the_skeleton_is_chosen_by_name():
    def choose(*names: str) -> str:
        paths = [Path(name) for name in names]
        return asf_amc.choose_skeleton(Path("HDM_bd_hop_120.amc"), paths).name

    assert choose("01.asf", "HDM_bd.asf", "HDM.asf") == "HDM_bd.asf"
    assert choose("anything.asf") == "anything.asf"
    with pytest.raises(MotionError, match="none is clearly its own"):
        choose("01.asf", "02.asf")


def test_loops_are_cut_where_they_repeat(tmp_path):
    clip = imported(tmp_path, files.bvh(frames=100), loop=True).clip
    assert clip.loop
    assert clip.duration == pytest.approx(round(clip.duration), abs=0.11)


def test_trimming_takes_the_given_seconds(tmp_path):
    clip = imported(tmp_path, files.bvh(frames=90), trim=(1.0, 2.0)).clip
    assert clip.duration == pytest.approx(1.0, abs=0.05)
    with pytest.raises(MotionError, match="nothing between 7 and"):
        imported(tmp_path, files.bvh(), trim=(7.0, 9.0))
