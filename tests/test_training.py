"""Runs that are killed, stopped and resumed, in processes of their own."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from dcc_jax.training import checkpoint, logs, loop
from dcc_jax.training.folder import RunError
from toy import Toy
from toy_run import INTERVAL, toy_config

UPDATES = 60
SCRIPT = Path(__file__).parent / "toy_run.py"


def _start(run_dir: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(run_dir), str(UPDATES), *options]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def _lines(run_dir: Path) -> int:
    path = run_dir / "metrics.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _wait_for(process: subprocess.Popen[str], run_dir: Path, lines: int) -> None:
    deadline = time.monotonic() + 300
    while _lines(run_dir) < lines and process.poll() is None:
        assert time.monotonic() < deadline, "the run does not get on"
        time.sleep(0.002)


def _comparable(run_dir: Path) -> list[str]:
    """The lines of metrics.jsonl without the fields that tell of the machine."""
    entries = logs.read(run_dir)
    for entry in entries:
        for name in logs.WALL_CLOCK:
            del entry[name]
    return [json.dumps(entry) for entry in entries]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("runs") / "whole"
    process = _start(run_dir)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert output.rstrip().endswith("finished")
    assert "compiled in" in output
    return run_dir


def test_uninterrupted_run_leaves_everything_to_read(uninterrupted):
    entries = logs.read(uninterrupted)
    assert [entry["update"] for entry in entries] == list(range(1, UPDATES + 1))
    named = {
        *("update", "tuples", "tuples_per_second", "seconds", "nan_count"),
        *("reward/total", "reward/r_q", "reward/r_p", "reward/r_task"),
        *("episode/length", "episode/fall_rate", "env/distance"),
        *("disc/loss", "disc/accuracy_real", "disc/accuracy_fake"),
        *("ppo/kl", "ppo/clip_fraction", "ppo/skipped", "disc/skipped"),
    }
    assert named <= entries[0].keys()
    measured = [entry["update"] for entry in entries if "style/frechet" in entry]
    assert measured == list(range(INTERVAL, UPDATES + 1, INTERVAL))
    assert checkpoint.available(uninterrupted) == [60, 50, 40]
    assert list((uninterrupted / "tensorboard").iterdir())
    checkpoint.load_policy(uninterrupted)


def test_run_killed_at_random_and_resumed_is_the_same_run(uninterrupted, tmp_path):
    run_dir = tmp_path / "killed"
    rng = random.Random(0)
    at = sorted(rng.sample(range(1, UPDATES - 5), 5))
    for i, lines in enumerate(at):
        process = _start(run_dir, *["--resume"] * (i > 0))
        _wait_for(process, run_dir, lines)
        process.kill()
        output, _ = process.communicate()
        assert process.returncode == -signal.SIGKILL, output
    process = _start(run_dir, "--resume")
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert _comparable(run_dir) == _comparable(uninterrupted)
    ours, theirs = (checkpoint.load_policy(d) for d in (run_dir, uninterrupted))
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_resume_of_a_finished_run_compiles_nothing(uninterrupted, tmp_path):
    run_dir = tmp_path / "again"
    shutil.copytree(uninterrupted, run_dir)
    process = _start(run_dir, "--resume")
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert f"resuming {run_dir} after update {UPDATES}" in output
    assert "compiling" not in output and "compiled in" not in output
    assert _comparable(run_dir) == _comparable(uninterrupted)


def test_policy_of_a_run_is_the_mean_of_those_of_its_updates(tmp_path):
    def kernel(updates: int, averaged: int) -> np.ndarray:
        config = toy_config(updates)
        train = dataclasses.replace(config.train, averaged_updates=averaged)
        config = dataclasses.replace(config, train=train)
        run_dir = tmp_path / f"{updates}-{averaged}"
        loop.train(config, run_dir=run_dir, environment=Toy(), quiet=True)
        return np.asarray(checkpoint.load_policy(run_dir).params.layers[0].kernel)

    one, two = kernel(1, 1), kernel(2, 1)
    assert np.abs(two - one).max() > 1e-5
    np.testing.assert_allclose(kernel(2, 5), 0.5 * (one + two), rtol=1e-5, atol=1e-8)


def test_run_that_cannot_go_on_stays_as_it_is(tmp_path, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(checkpoint, "_STATE_FORMAT", checkpoint._STATE_FORMAT - 1)
        loop.train(toy_config(2), run_dir=tmp_path, environment=Toy(), quiet=True)
    before = {p.name: p.read_bytes() for p in tmp_path.glob("*.*")}
    with pytest.raises(RunError, match="written by an older version"):
        loop.train(
            toy_config(4),
            run_dir=tmp_path,
            resume=True,
            environment=Toy(),
            quiet=True,
        )
    assert {p.name: p.read_bytes() for p in tmp_path.glob("*.*")} == before


def test_sigterm_saves_says_so_and_leaves_with_zero(uninterrupted, tmp_path):
    run_dir = tmp_path / "stopped"
    process = _start(run_dir)
    _wait_for(process, run_dir, 13)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "stopped by SIGTERM after update" in output
    newest = checkpoint.available(run_dir)[0]
    assert newest == _lines(run_dir) < UPDATES
    assert _comparable(run_dir) == _comparable(uninterrupted)[:newest]


def test_metrics_after_the_checkpoint_and_a_line_cut_short_are_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    whole = "".join(json.dumps({"update": i}) + "\n" for i in range(1, 6))
    path.write_text(whole + '{"upda')
    log = logs.RunLog(tmp_path, 3)
    log.write({"update": 4.0, "ppo/kl": float("nan")})
    log.close()
    assert logs.read(tmp_path)[-2:] == [
        {"update": 3},
        {"update": 4.0, "ppo/kl": None},
    ]


def test_progress_line_tells_how_far_and_how_well():
    line = logs.progress_line(
        {
            "update": 3,
            "tuples": 500_000,
            "tuples_per_second": 2500.0,
            "reward/total": 0.5,
            "reward/r_q": 0.6,
            "reward/r_p": 0.7,
            "reward/r_task": 0.0,
            "episode/length": 42,
            "episode/fall_rate": 0.25,
            "disc/accuracy_real": 0.9,
            "disc/accuracy_fake": 0.8,
        },
        total=2_000_000,
    )
    for part in ("update 3", "0.50/2.00 M", "2,500/s", "0:10:00 left", "falls 25%"):
        assert part in line


def test_environment_that_breaks_is_counted_and_dumped(tmp_path):
    result = loop.train(
        toy_config(2),
        run_dir=tmp_path / "run",
        environment=Toy(poisoned=True),
        quiet=True,
    )
    assert result.metrics[-1]["nan_count"] > 0
    dumps = sorted((tmp_path / "run" / "nan").iterdir())
    with np.load(dumps[0], allow_pickle=False) as dump:
        assert dump["env.obs"].shape == (3,) and dump["action"].shape == (2,)
    kernel = result.params.params.layers[0].kernel
    assert np.isfinite(kernel).all()


def test_run_whose_metrics_were_lost_goes_on(tmp_path):
    for updates in (INTERVAL, INTERVAL + 2):
        result = loop.train(
            toy_config(updates),
            run_dir=tmp_path / "run",
            resume=updates > INTERVAL,
            environment=Toy(),
            quiet=True,
        )
        (result.run_dir / "metrics.jsonl").unlink()
    assert [row["update"] for row in result.metrics] == [INTERVAL + 1, INTERVAL + 2]
