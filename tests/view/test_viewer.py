"""The loop between a simulation and a page, without physics and without a browser."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dcc_jax.character import asset_path
from dcc_jax.motion.clip import load_clip
from still import Still

pytest.importorskip("viser")

from dcc_jax.view import __main__ as command
from dcc_jax.view import saving, server, status, viewer
from dcc_jax.view.plots import CHARTS, data


def until(happens, seconds: float = 60.0):
    end = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """() -> a viewer that runs."""
    patch = pytest.MonkeyPatch()
    patch.setattr(viewer, "Program", Still)
    running = []

    def started():
        page = server.start("127.0.0.1", server.free_port("127.0.0.1", 8700))
        out = tmp_path_factory.mktemp("saved")
        made = viewer.Viewer(page, "push", ("push", "door"), out=out)
        loop = threading.Thread(target=made.run, daemon=True)
        loop.start()
        running.append((made, loop, page))
        return made

    yield started
    for made, loop, page in running:
        made.close()
        loop.join(20.0)
        assert not loop.is_alive()
        page.stop()
    patch.undo()


@pytest.fixture(scope="module")
def first(start):
    made = start()
    until(lambda: made.simulation is not None and made.simulation.history)
    return made


@pytest.fixture
def live(first):
    """The viewer at the beginning of an episode that nobody disturbs."""
    first.panel.paused.value = False
    first.ask(lambda simulation: first.restart(seed=0))
    until(lambda: first._queue.empty())
    return first


def mouse(live, phase, body="left_hand", client=7, end=(0.0, 0.3, 1.0)):
    event = SimpleNamespace(
        client_id=client, phase=phase, start_position=(0.0, 0.2, 0.9), end_position=end
    )
    live._dragged(body, event)


def test_drag_pulls_and_its_end_lets_go(live):
    mouse(live, "start")
    until(lambda: live.simulation.hands.stiffness.any())
    hands = live.simulation.hands
    assert hands.body[0] == live.simulation.environment.scene.body("left_hand")
    assert hands.stiffness[0] == live.panel.spring.value
    mouse(live, "update", end=(0.0, 0.4, 1.0))
    until(lambda: live._grab is not None and live._grab.target[1] == 0.4)
    mouse(live, "end")
    until(lambda: not live.simulation.hands.stiffness.any())


def test_two_browsers_pull_in_turn_and_the_one_that_leaves_lets_go(live):
    mouse(live, "start", client=1)
    mouse(live, "start", body="head", client=2)
    mouse(live, "end", client=1)
    until(lambda: live._grab is not None and live._grab.body == "head")
    live._queue.put(lambda: live._left(1))
    until(lambda: live._queue.empty())
    assert live._grab is not None
    live._queue.put(lambda: live._left(2))
    until(lambda: live._grab is None)


def test_mouse_pulls_with_a_thousand_newtons_at_most(live):
    mouse(live, "start", end=(1e6, 0.0, 1.0))
    until(lambda: live.simulation.hands.stiffness.any())
    hands = live.simulation.hands
    stretch = hands.target_w[0] - live._stage.place_w(live._grab)
    newtons = hands.stiffness[0] * np.linalg.norm(stretch)
    assert newtons == pytest.approx(viewer.LARGEST_FORCE, rel=1e-3)


def test_physics_that_breaks_is_said_and_the_loop_goes_on(live):
    live.simulation.program.broken = True
    until(lambda: "the physics broke" in live.note)
    live.simulation.program.broken = False
    until(lambda: live.simulation.episode > 0)
    until(lambda: live.simulation.history[-1].time > 0.2)


def test_error_of_a_control_is_a_line_on_the_page(live):
    live.ask(lambda simulation: simulation.act("fly"))
    until(lambda: "&#x27;fly&#x27;" in live.panel.status.content)
    before = live.simulation._count
    until(lambda: live.simulation._count > before)


def test_unknown_and_broken_policies_are_said_and_the_old_one_plays_on(live, tmp_path):
    before = live.simulation
    live.load("nobody")
    until(lambda: "nobody is not a run directory" in live.note)
    broken = tmp_path / "broken"
    shutil.copytree(asset_path("policies/push"), broken)
    (broken / "policy.npz").write_bytes(b"nothing")
    live.load(str(broken))
    until(lambda: "policy.npz" in live.note)
    assert live.simulation is before
    count = before._count
    until(lambda: before._count > count)


def test_policy_of_another_task_takes_the_stage_and_offers_what_it_can(live):
    live.load("door", {"width": 1.5})
    until(lambda: live.simulation is not None and live.name == "door")
    assert live.simulation.task.width == 1.5
    until(lambda: live.simulation.history)
    labels = [handle.label for handle in live.panel._own]
    assert labels == ["width, m", "make it that width"]
    live.load("push")
    until(lambda: live.name == "push" and "throw a ball" in live.panel._own[0].label)


def test_two_viewers_at_once_have_a_port_each(live, start):
    other = start()
    assert live.server.get_port() != other.server.get_port()
    until(lambda: other.simulation is not None)
    other.close()


def test_pause_step_and_reset(live):
    live.panel.paused.value = True
    until(lambda: "paused" in live.panel.status.content)
    count = live.simulation._count
    live.ask(lambda simulation: live.one_step())
    until(lambda: live.simulation._count == count + 1)
    live.ask(lambda simulation: live.restart(seed=5))
    simulation = live.simulation
    until(lambda: (simulation.seed, simulation._count, simulation.episode) == (5, 0, 0))


def test_clip_that_is_saved_can_be_read(live):
    until(lambda: len(live.simulation.history) > 5)
    live.save("npz")
    until(lambda: live.note.startswith("saved"))
    (path,) = live.out.glob("*.npz")
    clip = load_clip(path)
    assert clip.fps == 30 and len(clip.qpos) > 5
    assert "policy push" in clip.source


def test_nothing_to_save_is_said(live):
    with pytest.raises(ValueError, match="nothing has happened"):
        saving.save(live.simulation, [], "npz", 0.0, live.out)


def test_charts_end_now_and_are_empty_where_nothing_is_remembered(live):
    until(lambda: len(live.simulation.history) > 5)
    seconds, force = data(CHARTS[0], list(live.simulation.history)[:3])
    assert seconds[-1] == 0.0 and len(seconds) == 300
    assert np.isnan(force[:-3]).all() and np.isfinite(force[-3:]).all()


def test_sign_that_the_machine_cannot_keep_up(live):
    until(lambda: "paused" not in live.status_text())
    live.real_time_factor = 0.5
    assert "cannot keep up" in live.status_text()
    live.real_time_factor = 1.0
    assert "cannot keep up" not in live.status_text()


def test_meter_counts_from_its_beginning_and_waits_for_a_second(monkeypatch):
    monkeypatch.setattr(status, "time", SimpleNamespace(perf_counter=lambda: 10.0))
    meter = status.Meter(0.5)
    assert meter.factor(10.5) == 0.5
    meter.count(0.6)
    assert meter.factor(11.5) == pytest.approx(0.4)


def test_pause_is_not_taken_for_a_machine_that_cannot_keep_up(live):
    live.panel.paused.value = True
    until(lambda: "paused" in live.status_text())
    time.sleep(1.5)  # most of what a meter looks back on
    live.panel.paused.value = False
    steps = len(live.simulation.history)
    until(lambda: "paused" not in live.status_text())
    until(lambda: live.real_time_factor > 0.0)
    assert "cannot keep up" not in live.status_text()
    assert len(live.simulation.history) >= steps


@pytest.mark.parametrize(
    ("argv", "parts"),
    [
        (["nobody"], ["nobody is not a run directory", "push"]),
        (["push", "--port", "0"], ["--port must be in [1, 65535], got 0"]),
        (["push", "--alpha", "1.5"], ["--alpha must be in [0, 0.9], got 1.5"]),
        (["push", "--host", "203.0.113.7"], ["host must be", "203.0.113.7"]),
        (["push", "--bogus"], ["--bogus"]),
        (["push", "--task.width", "1"], ["width"]),
    ],
)
def test_bad_input_is_one_line_and_status_two(argv, parts, capsys):
    assert command.main(argv) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    for part in parts:
        assert part in line


def test_viser_that_is_missing_is_named(monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    assert command.main([]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "pip install 'dcc-jax[view]'" in line


def test_known_policies_begin_with_push_and_end_with_those_under_runs(
    tmp_path, monkeypatch
):
    from dcc_jax.play.runs import known_runs
    from dcc_jax.tasks import TASKS

    shutil.copytree(asset_path("policies/push"), tmp_path / "runs" / "mine")
    monkeypatch.chdir(tmp_path)
    known = known_runs()
    assert known[0] == "push" and known[-1] == str(Path("runs", "mine"))
    assert len(known) == len(set(known)) and set(TASKS) < set(known)
    more = {"ball-rolling", "sustained-push-tracking"}
    assert set(known) - set(TASKS) == {known[-1]} | more
