"""Damaged and hostile files: one line, status 2, nothing written, no hang."""

from __future__ import annotations

import io
import json
import pickle
import re
import resource
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import motion_files as files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dcc_jax.motion.__main__ import main
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.retarget import importer
from dcc_jax.motion.retarget.importer import Options


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """Status, stdout and stderr of the command."""
    status = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def refused(capsys, folder: Path, name: str, data: str | bytes) -> str:
    """The one line with which the command refuses a file."""
    source = folder / name
    source.write_bytes(data.encode() if isinstance(data, str) else data)
    before = sorted(folder.iterdir())
    status, _, err = run(capsys, "import", source, "--out", folder / "out.npz")
    assert status == 2, err
    assert sorted(folder.iterdir()) == before
    assert err.startswith(f"dcc_jax.motion.import: {source}:") and err.count("\n") == 1
    return err


def bvh_with(old: str, new: str, count: int = 1) -> str:
    text = files.bvh(frames=4)
    assert old in text
    return text.replace(old, new, count)


def last_number_as(token: str) -> str:
    head, _, _ = files.bvh(frames=4).rstrip().rpartition(" ")
    return f"{head} {token}\n"


def lost_number() -> str:
    """The file without the first number of its second row."""
    rows = files.bvh(frames=4).splitlines()
    rows[-3] = rows[-3].partition(" ")[2]
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the file is empty"),
        ("hello", "the format is none of"),
        (bvh_with("MOTION", "MOTIN"), "has no MOTION section"),
        (bvh_with("Frames: 4", "Frames: 0"), "claims 0 frames"),
        (bvh_with("Frames: 4", "Frames: 1000000000"), "claims 1000000000 frames of"),
        (bvh_with("Frames: 4", "Frames: 9"), "claims 9 frames of 69 numbers, holds 4"),
        (bvh_with("Frames: 4", "Frames: 1"), "claims 1 frames of 69 numbers, holds 4"),
        (bvh_with("Frames: 4", "Frames: many"), "expected a number"),
        (bvh_with("Frame Time: 0.0", "Frame Time: -0.0"), "frame time"),
        (bvh_with("CHANNELS 3", "CHANNELS 9"), "9 channels"),
        (bvh_with("Xrotation", "Wrotation"), "unknown channel"),
        (bvh_with("OFFSET", "OFFSET nan"), "not finite"),
        (
            bvh_with("LeftLeg", "Stick").replace("LeftUpLeg", "Pole"),
            "found no joint for pelvis, chest, head, left_thigh, left_shin",
        ),
        (bvh_with("}\nMOTION", "}}\nMOTION"), "unexpected '}}'"),
        (last_number_as("nan"), "not finite"),
        (last_number_as("1e999"), "not finite"),
        (last_number_as("0x1f"), "expected a number"),
        (lost_number(), "a row of 68 numbers, not 69"),
        (re.sub(r"CHANNELS .*", "CHANNELS 0", files.bvh(4)), "no joint has a channel"),
        ("HIERARCHY\n" + "ROOT a\n{\nOFFSET 0 0 0\n" * 5000 + "MOTION\n", "unexpected"),
        (
            "HIERARCHY ROOT a { OFFSET 0 0 0\n"
            + "".join(f"JOINT j{k} {{ OFFSET 0 0 0\n" for k in range(5000))
            + "MOTION\n",
            "more than 1000 joints",
        ),
    ],
)
def test_a_damaged_bvh_is_refused(capsys, tmp_path, text, reason):
    assert reason in refused(capsys, tmp_path, "bad.bvh", text)


def amc_with(old: str, new: str) -> str:
    text = files.amc(frames=4)
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (":FULLY-SPECIFIED\n:DEGREES\n", "holds no frames"),
        (amc_with("\n3\n", "\n7\n"), "frame 7 follows frame 2"),
        (amc_with("ltibia 0.0", "ltibia 0.0 1.0"), "has 2 values, not 1"),
        (amc_with("ltibia 0.0", "ltibia nan"), "'nan' is not finite"),
        (amc_with("ltibia 0.0", "ltibia zero"), "expected a number"),
        (amc_with("ltibia 0.0", "tail 0.0"), "unknown bone 'tail'"),
        (amc_with("ltibia 0.0", "lfemur 0 0 0"), "out of place"),
        (files.amc(frames=4) + "\x00\x01", "binary data"),
    ],
)
def test_a_damaged_amc_is_refused(capsys, tmp_path, text, reason):
    (tmp_path / "07.asf").write_text(files.asf())
    assert reason in refused(capsys, tmp_path, "07_01.amc", text)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("root lhipjoint", "rfoot lhipjoint", "does not hang on the root"),
        ("lfemur ltibia", "lfemur ltibia\n ltibia lfemur", "has two parents"),
        ("axis XYZ", "axis XXY", "unknown order of axes"),
        ("length 7.4", "length inf", "not finite"),
        ("length 0.45", "length -1", "unit of length"),
        (":bonedata", ":bones", "no :bonedata"),
        ("dof rx ry rz", "dof rx ry rw", "unknown dof"),
        ("lfemur ltibia", "lfemur shinbone", "unknown bone 'shinbone'"),
    ],
)
def test_a_damaged_skeleton_is_refused(capsys, tmp_path, old, new, reason):
    assert old in files.asf()
    source, skeleton = tmp_path / "07_01.amc", tmp_path / "07.asf"
    source.write_text(files.amc(frames=4))
    skeleton.write_text(files.asf().replace(old, new, 1))
    status, _, err = run(capsys, "import", source, "--out", tmp_path / "out.npz")
    assert status == 2 and reason in err and err.count("\n") == 1
    assert err.startswith(f"dcc_jax.motion.import: {skeleton}:")
    assert not (tmp_path / "out.npz").exists()


def test_a_motion_without_any_skeleton_is_refused(capsys, tmp_path):
    assert "needs its skeleton" in refused(capsys, tmp_path, "1.amc", files.amc(2))


def deepmimic(frames: int = 4, **changes: object) -> dict:
    """A standing DeepMimic clip."""
    one = [1.0, 0.0, 0.0, 0.0]
    frame = [0.03, 0, 0.9, 0] + one * 3 + one + [-0.1] + one * 2 + [0.2]
    frame += one + [-0.1] + one * 2 + [0.2]
    return {"Loop": "none", "Frames": [frame] * frames, **changes}


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        ({"Loop": "wrap"}, "no 'Frames'"),
        (deepmimic(0), "holds no frames"),
        (deepmimic(1), "needs 2 frames"),
        (deepmimic(Frames=[[0.0] * 43] * 2), "has 43 numbers, not 44"),
        (deepmimic(Frames=[["1"] * 44] * 2), "what is not a number"),
        (deepmimic(Frames=[[float("nan")] * 44] * 2), "not finite"),
        (deepmimic(Frames=[[0.03] + [0.0] * 43] * 2), "quaternion of norm 0"),
        (deepmimic(Frames=[[0.0] + [1.0] * 43] * 2), "frame 0 lasts 0.0 s"),
    ],
)
def test_a_damaged_deepmimic_clip_is_refused(capsys, tmp_path, document, reason):
    line = refused(capsys, tmp_path, "clip.txt", json.dumps(document))
    assert reason in line


def test_json_that_is_no_json_is_refused(capsys, tmp_path):
    assert ":1: not JSON" in refused(capsys, tmp_path, "clip.txt", '{"Frames": [[')
    nested = '{"Frames": ' + "[" * 100_000
    assert "not JSON" in refused(capsys, tmp_path, "clip.txt", nested)


def poselib(**changes: object) -> bytes:
    """A poselib archive of one standing figure with some arrays exchanged."""
    rows = files.FIGURE
    arrays = {
        "fps": np.array(60),
        "is_local": np.array(True),
        "node_names": np.array([name for name, _, _ in rows]),
        "parent_indices": np.array([parent for _, parent, _ in rows]),
        "local_translation": np.array([offset for _, _, offset in rows]),
        "root_translation": np.tile([0.0, 0.0, 0.98], (30, 1)),
        "rotation_xyzw": np.tile([0.0, 0.0, 0.0, 1.0], (30, len(rows), 1)),
    } | changes
    stream = io.BytesIO()
    np.savez(
        stream, **{key: value for key, value in arrays.items() if value is not None}
    )
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (poselib(fps=None), "lacks fps"),
        (poselib(node_names=np.array([print] * 22)), "pickled objects"),
        (
            poselib(parent_indices=np.array([-1, *range(2, 23)])),
            "cannot have the parent",
        ),
        (poselib(parent_indices=np.arange(22)), "cannot have the parent 0"),
        (poselib(rotation_xyzw=np.ones((30, 3, 4))), "rotation_xyzw is"),
        (poselib(rotation_xyzw=np.zeros((30, 22, 4))), "far from unit length"),
        (poselib(root_translation=np.full((30, 3), np.inf)), "not finite"),
        (poselib(fps=np.array(0.0)), "frame rate 0.0 is not credible"),
        (poselib()[:-40], "not a readable npz archive"),
        (b"PK\x03\x04 not really a zip", "not a readable npz archive"),
    ],
)
def test_a_damaged_poselib_archive_is_refused(capsys, tmp_path, data, reason):
    assert reason in refused(capsys, tmp_path, "clip.npz", data)


def test_a_bomb_is_not_unpacked(capsys, tmp_path):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("a.npy", "b.npy"):
            with archive.open(name, "w") as member:
                for _ in range(520):
                    member.write(bytes(1 << 20))
    line = refused(capsys, tmp_path, "bomb.npz", stream.getvalue())
    assert "unpacks to more than" in line


def within_a_gigabyte(folder: Path, source: Path, *options: str) -> str:
    """The last line of an import that may not take more; it ends in any case."""
    command = [sys.executable, "-m", "dcc_jax.motion", "import", str(source)]
    done = subprocess.run(
        [*command, "--out", str(folder / "out.npz"), *options],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30)),
    )
    assert "Traceback" not in done.stderr
    return (done.stderr or done.stdout).strip().splitlines()[-1]


def test_few_bytes_cannot_claim_much_memory(tmp_path):
    still = re.sub(r"CHANNELS 3.*", "CHANNELS 0", files.bvh(frames=2))
    still = still.replace("Frames: 2", "Frames: 1000000000").partition("Time:")[0]
    still += "Time: 0.033\n" + "0 0 0 0 0 0\n" * 5
    (tmp_path / "still.bvh").write_text(still)
    line = within_a_gigabyte(tmp_path, tmp_path / "still.bvh")
    assert "claims 1000000000 frames" in line
    slow = [
        [1.0e-3 if k % 2 else 10.0, *f[1:]]
        for k, f in enumerate(deepmimic(60)["Frames"])
    ]
    (tmp_path / "slow.txt").write_text(json.dumps({"Loop": "wrap", "Frames": slow}))
    assert "verdict" in within_a_gigabyte(tmp_path, tmp_path / "slow.txt")


def test_a_long_recording_is_searched_for_a_loop_in_bounded_memory(tmp_path):
    """Every frame against every other took 5.7 GB."""
    frames = [list(frame) for frame in deepmimic(9000)["Frames"]]
    for index, frame in enumerate(frames):
        frame[1] = 0.01 * np.sin(index / 7.0)
        frame[20] = -0.3 - 0.2 * np.sin(index / 7.0)
    (tmp_path / "long.txt").write_text(json.dumps({"Frames": frames}))
    line = within_a_gigabyte(tmp_path, tmp_path / "long.txt", "--loop", "--no-clean")
    assert "verdict" in line


@pytest.mark.parametrize(
    ("name", "kind"), [("m.npy", "poselib"), ("m.pkl", "MimicKit")]
)
def test_a_pickle_is_not_loaded_but_told_how_to_convert(capsys, tmp_path, name, kind):
    path = tmp_path / name
    value = {
        "fps": 30,
        "loop_mode": 0,
        "frames": np.load(io.BytesIO(mimickit()))["frames"],
        "is_local": True,
        **converted_from(np.load(io.BytesIO(poselib()))),
    }
    if name == "m.npy":
        np.save(path, np.array(value, dtype=object))
    else:
        path.write_bytes(pickle.dumps(value))
    line = refused(capsys, tmp_path, name, path.read_bytes())
    assert "not loaded" in line and kind in line
    program = line.strip().partition('python -c "')[2].removesuffix('"')
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    importer.import_motion(tmp_path / "m.npz", Options())


def converted_from(arrays) -> dict:
    """A poselib dictionary of a converted one."""
    return {
        "skeleton_tree": {
            "node_names": [str(name) for name in arrays["node_names"]],
            "parent_indices": {"arr": arrays["parent_indices"]},
            "local_translation": {"arr": arrays["local_translation"]},
        },
        "root_translation": {"arr": arrays["root_translation"]},
        "rotation": {"arr": arrays["rotation_xyzw"]},
    }


def test_several_sources_are_imported_and_the_bad_one_is_named(capsys, tmp_path):
    good, bad = tmp_path / "good.bvh", tmp_path / "bad.bvh"
    good.write_text(files.bvh(frames=20))
    bad.write_text(files.bvh(frames=20)[:-9000])
    out = tmp_path / "clips"
    status, stdout, err = run(capsys, "import", good, bad, "--out", out, "--mirror")
    assert status == 2 and f"{bad}:" in err
    assert sorted(path.name for path in out.iterdir()) == [
        "good.npz",
        "good_mirrored.npz",
    ]
    assert "foot skate in stance" in stdout
    status, stdout, _ = run(capsys, "inspect", out / "good.npz")
    assert status == 0 and "penetration" in stdout


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--fps", "0"], "fps must be in [1, 1000] frames/s, got 0"),
        (["--fps", "nan"], "fps must be in [1, 1000] frames/s, got nan"),
        (["--source-fps", "fast"], "--source-fps: could not convert"),
        (["--unit", "furlong"], "unit must be one of m, dm,"),
        (["--trim", "3:1"], "A:B with A < B, got '3:1'"),
        (["--trim", "3"], "A:B with A < B, got '3'"),
        (["--trim", "nan:1"], "A:B with A < B, got 'nan:1'"),
        (["--up", "w"], "up must be one of x, y, z, -x, -y, -z, got 'w'"),
        (["--low-pass", "-1"], "low_pass must be 0 or a frequency in Hz, got -1"),
        (["--format", "fbx"], "format must be one of auto, amc, bvh"),
        (["--map", "none.txt"], "none.txt: cannot be read"),
    ],
)
def test_a_bad_argument_is_one_line(capsys, tmp_path, arguments, reason):
    source = tmp_path / "a.bvh"
    source.write_text(files.bvh(frames=4))
    out = tmp_path / "out.npz"
    status, _, err = run(capsys, "import", source, "--out", out, *arguments)
    assert status == 2 and reason in err and err.count("\n") == 1
    assert not out.exists()


def test_inspecting_what_is_no_clip_is_one_line(capsys, tmp_path):
    path = tmp_path / "no.npz"
    path.write_bytes(poselib())
    status, _, err = run(capsys, "inspect", path)
    reason = "not a clip (its layout is not 'dcc_jax clip 1')"
    assert status == 2 and err == f"dcc_jax.motion.inspect: {path}: {reason}\n"


REAL = [
    files.MOTIONS / "cmu_asfamc" / "02_03.amc",
    files.MOTIONS / "cmu_asfamc" / "02.asf",
    files.MOTIONS / "mass_bvh" / "run.bvh",
    files.MOTIONS / "deepmimic" / "humanoid3d_jog.txt",
    files.MOTIONS / "amp_poselib_npz" / "amp_humanoid_run.npz",
]


def amass(**changes: object) -> bytes:
    """An AMASS archive of a standing figure."""
    numbers = np.random.default_rng(0)
    arrays = {
        "poses": numbers.normal(0.0, 0.05, (12, 156)),
        "trans": np.zeros((12, 3)),
        "betas": np.zeros(16),
        "mocap_framerate": np.array(30.0),
    } | changes
    stream = io.BytesIO()
    np.savez(
        stream, **{key: value for key, value in arrays.items() if value is not None}
    )
    return stream.getvalue()


def mimickit(**changes: object) -> bytes:
    """A converted MimicKit clip of a standing figure."""
    frames = np.zeros((12, 34))
    frames[:, 2] = 0.9
    arrays = {"frames": frames, "fps": np.array(30), "loop": np.array(0)} | changes
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (amass(trans=np.zeros((5, 3))), r"trans is (5, 3), not (12, 3)"),
        (amass(poses=np.zeros((12, 60))), "poses are (12, 60), not [T, 66 or more]"),
        (amass(poses=np.full((12, 66), np.nan)), "poses holds a number"),
        (amass(mocap_framerate=np.array(0.0)), "frame rate 0.0 is not credible"),
        (amass(poses=None, pose_body=np.zeros((12, 63))), "without root_orient"),
        (mimickit(frames=np.zeros((12, 35))), "not [T, 34] of the humanoid"),
        (mimickit(fps=np.array("x")), "fps is"),
        (poselib(local_translation=np.zeros((22, 3))), "found no joint for"),
    ],
)
def test_a_damaged_archive_is_refused(capsys, tmp_path, data, reason):
    assert reason in refused(capsys, tmp_path, "clip.npz", data)


SEEDS = {
    "seed_1.amc": files.amc(frames=6).encode(),
    "seed.asf": files.asf().encode(),
    "seed.bvh": files.bvh(frames=6).encode(),
    "seed.txt": json.dumps(deepmimic()).encode(),
    "seed.npz": poselib(),
    "amass.npz": amass(),
    "mimic.npz": mimickit(),
}
MANY = 2000  # mutants of each format, where time does not matter
LONGEST = 5.0  # s of processor time; an import takes less than 1
BYTES = st.one_of(
    st.binary(max_size=6),
    st.sampled_from(
        [b"nan", b"-1", b"1e308", b"{", b"}", b"\n", b" ", b"0", b"[", b":"]
    ),
)
EDITS = st.lists(
    st.tuples(st.floats(0.0, 1.0), st.integers(0, 40), BYTES), min_size=1, max_size=3
)


def mutated(data: bytes, edits, end: float) -> bytes:
    """The data with stretches replaced, then cut at a share of its length."""
    for place, length, new in edits:
        at = int(place * len(data))
        data = data[:at] + new + data[at + length :]
    return data[: int(end * len(data))] if end < 1.0 else data


def survives(folder: Path, name: str, data: bytes, skeleton: bytes) -> None:
    """Reading the data gives a clip or a MotionError of one line."""
    (folder / "seed.asf").write_bytes(skeleton)
    path = folder / name
    path.write_bytes(data)
    motion = path if path.suffix != ".asf" else folder / "seed_1.amc"
    if not motion.exists():
        motion.write_bytes(SEEDS["seed_1.amc"])
    before = time.process_time()
    try:
        importer.import_motion(motion, Options())
    except MotionError as error:
        assert "\n" not in str(error) and str(error).startswith(str(folder))
    assert time.process_time() - before < LONGEST


MUTANT = {"edits": EDITS, "end": st.one_of(st.just(1.0), st.floats(0.0, 1.0))}
ONE_PROCESS = {
    "deadline": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
}


@pytest.mark.parametrize("name", SEEDS)
@settings(max_examples=12, **ONE_PROCESS)
@given(**MUTANT)
def test_no_mutation_of_a_small_file_crashes(tmp_path, name, edits, end):
    survives(tmp_path, name, mutated(SEEDS[name], edits, end), SEEDS["seed.asf"])


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEDS)
@settings(max_examples=MANY, **ONE_PROCESS)
@given(**MUTANT)
def test_no_mutation_of_many_crashes(tmp_path, name, edits, end):
    survives(tmp_path, name, mutated(SEEDS[name], edits, end), SEEDS["seed.asf"])


@pytest.mark.skipif(not REAL[0].exists(), reason="no motion data here")
@pytest.mark.parametrize("source", REAL, ids=lambda path: path.name)
@settings(max_examples=3, **ONE_PROCESS)
@given(**MUTANT)
def test_no_mutation_of_a_real_file_crashes(tmp_path, source, edits, end):
    name = "seed.asf" if source.suffix == ".asf" else f"seed_1{source.suffix}"
    data = mutated(source.read_bytes(), edits, end)
    skeleton = data if source.suffix == ".asf" else REAL[1].read_bytes()
    if source.suffix == ".asf":
        (tmp_path / "seed_1.amc").write_bytes(REAL[0].read_bytes())
    survives(tmp_path, name, data, skeleton)


@pytest.mark.parametrize("name", ["seed.bvh", "seed_1.amc", "seed.txt", "seed.npz"])
def test_every_truncation_is_survived(tmp_path, monkeypatch, name):
    """At every byte; the retargeting of what still reads is tested elsewhere."""
    monkeypatch.setattr(importer, "_imported", lambda motion, options: motion)
    data = SEEDS[name] if name != "seed_1.amc" else files.amc(frames=2).encode()
    step = max(1, len(data) // 200)
    for length in range(0, len(data), step):
        survives(tmp_path, name, data[:length], SEEDS["seed.asf"])


def test_importers_need_no_jax():
    code = (
        "import sys, dcc_jax.motion.retarget.importer; sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize(
    ("text", "span"), [("1:2.5", (1.0, 2.5)), (":2", (0.0, 2.0)), ("1:", (1.0, np.inf))]
)
def test_a_span_may_lack_one_of_its_ends(text, span):
    assert importer.read_span(text) == span
