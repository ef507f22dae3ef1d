"""A person with a browser: opens the page, moves alpha, drags a hand, saves a film."""

from __future__ import annotations

import os
import shutil
import threading
from pathlib import Path

import browser
import numpy as np
import pytest

from dcc_jax.character import asset_path

pytest.importorskip("viser")
pytest.importorskip("selenium")

from selenium.webdriver.common.keys import Keys

from dcc_jax.view import server
from dcc_jax.view.grip import Grab
from dcc_jax.view.viewer import Viewer

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing()),
]
COMPILING = 600.0  # s, on a machine with other things to do


@pytest.fixture(scope="module")
def second_policy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A policy of the same task, so that one program serves both."""
    folder = tmp_path_factory.mktemp("runs") / "other"
    shutil.copytree(asset_path("policies/push"), folder)
    return str(folder)


@pytest.fixture(scope="module")
def viewer(second_policy: str, tmp_path_factory: pytest.TempPathFactory):
    page = server.start("127.0.0.1", server.free_port("127.0.0.1", 8500))
    out = tmp_path_factory.mktemp("saved")
    viewer = Viewer(page, "push", ("push", second_policy), out=out)
    # Graphics without a card share the cores with the physics.
    viewer.set_plain(True)
    viewer.panel.speed.value = 0.5
    loop = threading.Thread(target=viewer.run, daemon=True)
    loop.start()
    yield viewer
    viewer.close()
    loop.join(10.0)
    page.stop()


@pytest.fixture(scope="module")
def window(viewer):
    window = browser.opened(f"http://127.0.0.1:{viewer.server.get_port()}")
    yield window
    window.quit()


@pytest.fixture(scope="module")
def simulation(viewer, window):
    browser.until(lambda: viewer.simulation, COMPILING)
    simulation = viewer.simulation
    simulation.events_on = False
    browser.until(lambda: len(simulation.history) > 30)
    return simulation


def kept(window, name: str) -> None:
    """Keeps a picture of the page where `DCC_JAX_ARTEFACTS` says."""
    folder = Path(os.environ.get("DCC_JAX_ARTEFACTS", "artefacts"))
    folder.mkdir(parents=True, exist_ok=True)
    window.save_screenshot(str(folder / f"{name}.png"))


def test_page_shows_a_character_that_moves(window, viewer, simulation):
    browser.until(lambda: "real time" in browser.text(window))
    before = simulation.history[-1].motion.qpos
    browser.until(lambda: np.abs(simulation.history[-1].motion.qpos - before).max() > 0)
    errors = [e for e in window.get_log("browser") if e["level"] == "SEVERE"]
    assert not errors


def test_alpha_of_the_page_acts_and_u_off_takes_it_away(window, viewer, simulation):
    box = browser.field(window, "alpha")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("0.05", Keys.ENTER)
    browser.until(lambda: simulation.alpha == pytest.approx(0.05))
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("0.16", Keys.ENTER)
    browser.until(lambda: simulation.alpha == pytest.approx(0.16))
    window.execute_script("arguments[0].click()", browser.field(window, "u off"))
    browser.until(lambda: simulation.level == 0.0)
    assert simulation.told == pytest.approx(0.16)
    window.execute_script("arguments[0].click()", browser.field(window, "u off"))
    browser.until(lambda: simulation.level == pytest.approx(0.16))


def test_hand_dragged_with_the_mouse_pulls_and_u_answers(window, viewer, simulation):
    viewer.panel.spring.value = 150.0
    viewer.panel.paused.value = True
    browser.until(lambda: "paused" in browser.text(window))
    (client,) = viewer.server.get_clients().values()
    stage = viewer._stage
    hand = stage._model.body("left_hand").id
    model = stage._model
    middle = model.geom_pos[model.body_geomadr[hand]]  # not the wrist
    place = stage.place_w(Grab("left_hand", middle, np.zeros(3))) - stage.offset
    x, y = browser.pixel(window, client, place)
    browser.mouse(window, "mouseMoved", x, y, held=False)
    browser.mouse(window, "mousePressed", x, y)
    for step in range(1, 4):
        browser.mouse(window, "mouseMoved", x + 20 * step, y - 10 * step)
    grab = browser.until(lambda: viewer._grab)
    assert grab.body in ("left_hand", "left_forearm")
    viewer.panel.paused.value = False
    browser.until(lambda: np.linalg.norm(simulation.pull_force_w) > 5.0)
    browser.until(lambda: simulation.history[-1].numbers["displacement"] > 0.01)
    kept(window, "view-pull")
    force = np.linalg.norm(simulation.pull_force_w)
    assert 5.0 < force < 200.0
    browser.mouse(window, "mouseReleased", x + 60, y - 30)
    browser.until(lambda: viewer._grab is None)
    browser.until(lambda: np.linalg.norm(simulation.pull_force_w) == 0.0)


def test_push_of_the_panel_acts(window, viewer, simulation):
    browser.press(window, "push")
    browser.until(lambda: simulation.history[-1].numbers["force_peak"] > 50.0)


def test_ball_is_thrown_when_asked_for(window, viewer, simulation):
    browser.press(window, "throw a ball")
    ball = viewer._stage._model.body("ball").id
    browser.until(lambda: viewer._stage._data.xpos[ball][2] > 0.0)


def test_reset_begins_the_next_episode(window, viewer, simulation):
    episode = simulation.episode
    browser.press(window, "reset")
    browser.until(lambda: simulation.episode > episode)


@pytest.mark.parametrize("kind", ["film .gif", "clip .npz"])
def test_film_and_clip_are_saved(window, viewer, simulation, kind):
    browser.until(lambda: len(simulation.history) > 60)
    browser.press(window, kind)
    browser.until(lambda: list(viewer.out.glob(f"*{kind[4:].strip()}")), COMPILING)
    browser.until(lambda: "saved" in browser.text(window))


def test_policy_is_changed_on_the_page(window, viewer, simulation, second_policy):
    box = browser.field(window, "Policy")
    window.execute_script("arguments[0].focus(); arguments[0].click()", box)
    option = f"//*[@role='option'][normalize-space()='{second_policy}']"
    browser.until(lambda: window.find_elements("xpath", option))
    window.execute_script("arguments[0].click()", window.find_element("xpath", option))
    browser.until(lambda: viewer.name == second_policy)
    browser.until(lambda: viewer.simulation is not simulation)
    assert viewer.simulation.program is simulation.program
    kept(window, "view-end")


def test_page_that_is_closed_in_mid_drag_lets_go(viewer, window):
    simulation = viewer.simulation
    other = browser.opened(f"http://127.0.0.1:{viewer.server.get_port()}")
    browser.until(lambda: len(viewer.server.get_clients()) == 2)
    client = max(viewer.server.get_clients())
    point = viewer._stage._data.xpos[viewer._stage._model.body("chest").id]
    start = point - viewer._stage.offset
    viewer._queue.put(lambda: viewer._drag(client, "start", "chest", start, start))
    browser.until(lambda: viewer._grab)
    other.quit()
    browser.until(lambda: viewer._grab is None)
    browser.until(lambda: not simulation.hands.stiffness.any())
    assert len(viewer.server.get_clients()) == 1
