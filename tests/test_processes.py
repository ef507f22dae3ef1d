"""One training over two processes of this machine."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dcc_jax import runtime
from dcc_jax.training import checkpoint, logs

UPDATES = 60
SCRIPT = Path(__file__).parent / "toy_run.py"
COORDINATOR, COUNT, INDEX = (
    "DCC_JAX_COORDINATOR",
    "DCC_JAX_PROCESSES",
    "DCC_JAX_PROCESS",
)


def start(run_dir: Path, *options: str, **variables: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(run_dir), str(UPDATES), *options]
    return subprocess.Popen(
        command,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def start_two(run_dir: Path, *options: str) -> list[subprocess.Popen[str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    return [
        start(run_dir, *options, **{COORDINATOR: address, COUNT: "2", INDEX: str(i)})
        for i in range(2)
    ]


def ended(processes: list[subprocess.Popen[str]]) -> list[str]:
    """What each of them said."""
    try:
        return [process.communicate(timeout=300)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()


def rows(run_dir: Path) -> list[str]:
    return [
        json.dumps({k: v for k, v in row.items() if k not in logs.WALL_CLOCK})
        for row in logs.read(run_dir)
    ]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one process with two devices."""
    run_dir = tmp_path_factory.mktemp("runs") / "alone"
    process = start(run_dir, DCC_JAX_DEVICES="2")
    (output,) = ended([process])
    assert process.returncode == 0, output
    return run_dir


def test_stopped_and_resumed_it_is_the_run_of_one_process(alone, tmp_path):
    run_dir = tmp_path / "two"
    processes = start_two(run_dir)
    log, deadline = run_dir / "metrics.jsonl", time.monotonic() + 300
    while not log.exists() or log.read_bytes().count(b"\n") < 15:
        assert time.monotonic() < deadline, "the run does not get on"
        assert all(process.poll() is None for process in processes)
        time.sleep(0.002)
    processes[1].send_signal(signal.SIGTERM)
    first, second = ended(processes)
    assert [process.returncode for process in processes] == [0, 0], first + second
    assert "stopped by another process after update" in first
    assert "update" not in second, "it speaks beside the first"
    done = len(rows(run_dir))
    assert 15 <= done < UPDATES and checkpoint.available(run_dir)[0] == done

    resumed = ended(processes := start_two(run_dir, "--resume"))
    assert [process.returncode for process in processes] == [0, 0], resumed
    assert f"resuming {run_dir} after update {done}" in resumed[0]
    assert "another run" not in resumed[0]
    assert rows(run_dir) == rows(alone)
    policies = [path / "policy.npz" for path in (run_dir, alone)]
    assert policies[0].read_bytes() == policies[1].read_bytes()


def test_directory_in_use_is_refused_by_all(alone):
    processes = start_two(alone)
    first, second = ended(processes)
    assert all(process.returncode for process in processes)
    assert f"{alone} exists and is not empty" in first
    assert "process 0 could not begin; it says why" in second


def test_another_number_of_devices_is_told(alone, tmp_path):
    process = start(alone, "--resume", DCC_JAX_DEVICES="1")
    (output,) = ended([process])
    assert process.returncode == 0, output
    assert "it had 2 devices and goes on with 1: from here on" in output


@pytest.mark.parametrize(
    "said",
    [
        {COUNT: "2", INDEX: "0"},
        {COORDINATOR: "host:1", COUNT: "2"},
        {COORDINATOR: "host:1", COUNT: "2", INDEX: "2"},
        {COORDINATOR: "host:1", COUNT: "two", INDEX: "0"},
    ],
)
def test_half_of_what_is_needed_is_one_line(said, monkeypatch):
    for name in (COORDINATOR, COUNT, INDEX):
        monkeypatch.delenv(name, raising=False)
    for name, text in said.items():
        monkeypatch.setenv(name, text)
    with pytest.raises(ValueError, match="several processes need DCC_JAX_COORDINATOR="):
        runtime._processes()
