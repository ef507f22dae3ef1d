"""From a BVH on disk to a training, to a verdict, and back to BVH."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rewritten import Rig, far_off, imported, shipped

from dcc_jax import tasks
from dcc_jax.character import asset_path
from dcc_jax.motion.__main__ import main
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.play import player, runs

WALK = shipped("walk", 60, 100)


@pytest.fixture
def walk(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(Rig().text(WALK))
    return path


def test_an_import_ends_with_the_verdict_and_inspect_opens_with_it(walk, capsys):
    out = walk.with_suffix(".npz")
    assert main(["import", str(walk), "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "  verdict: good"
    assert main(["inspect", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "verdict: good"


def test_a_clip_that_sinks_is_to_be_checked(tmp_path, capsys):
    from dataclasses import replace

    from dcc_jax.motion.clip import save_clip

    qpos = WALK.qpos - np.eye(1, 55, 2, dtype=np.float32) * np.float32(0.3)
    save_clip(tmp_path / "low.npz", replace(WALK, qpos=qpos))
    assert main(["inspect", str(tmp_path / "low.npz")]) == 0
    assert "check: a foot is 30 cm in the ground" in capsys.readouterr().out


def test_a_training_takes_a_bvh_at_once(walk, capsys):
    clip = tasks._clip(str(walk))
    assert far_off(clip, WALK)[0].max() < 3.0
    assert "verdict: good" in capsys.readouterr().err
    walk.write_text("HIERARCHY\n")
    with pytest.raises(MotionError, match=r"walk\.bvh"):
        tasks._clip(str(walk))


def test_a_clip_is_no_bvh_and_a_bvh_no_clip(walk, capsys):
    assert main(["import", str(walk), "--out", str(walk.with_name("o.bvh"))]) == 2
    assert "a clip ends in .npz" in capsys.readouterr().err
    assert not walk.with_name("o.bvh").exists()
    assert main(["export", "walk", "--out", str(walk.with_name("o.npz"))]) == 2
    assert "--out must end in .bvh" in capsys.readouterr().err


@pytest.mark.parametrize("source", ["walk_cycle", "a file"])
def test_a_clip_is_exported_and_read_back(tmp_path, capsys, source):
    path = str(asset_path("motions/walk_cycle.npz"))
    out = tmp_path / "out.bvh"
    name = source if source == "walk_cycle" else path
    assert main(["export", name, "--out", str(out)]) == 0
    angles, place = far_off(
        imported(tmp_path, out.read_text(), clean=False).clip, shipped("walk_cycle")
    )
    assert angles.max() < 0.1 and place < 0.001


def test_what_a_policy_did_is_exported_until_it_falls(tmp_path, monkeypatch):
    """The character's part of the scene's qpos, of the control steps of the episode."""
    frames = len(WALK.qpos)
    scene_qpos = np.concatenate([np.ones((frames, 7)), WALK.qpos], axis=1)[:, None]

    class Playing:
        def __init__(self, environment):
            pass

        def play(self, run, episodes, alpha, **others):
            assert others["motion"] and list(alpha) == [0.16]
            alive = (np.arange(frames) < 30)[:, None]
            motion = SimpleNamespace(qpos=scene_qpos)
            return SimpleNamespace(alive=alive, motion=motion)

    run = SimpleNamespace(name="pushed", alphas=(0.0, 0.16))
    scene = SimpleNamespace(character_qpos=lambda qpos: qpos[..., 7:])
    monkeypatch.setattr(runs, "find_run", lambda name: run)
    monkeypatch.setattr(
        runs, "make_environment", lambda run: SimpleNamespace(scene=scene)
    )
    monkeypatch.setattr(player, "Player", Playing)
    out = tmp_path / "out.bvh"
    assert main(["export", "runs/pushed", "--out", str(out)]) == 0
    ours = imported(tmp_path, out.read_text(), clean=False).clip
    assert far_off(ours, shipped("walk", 60, 90))[0].max() < 0.1
