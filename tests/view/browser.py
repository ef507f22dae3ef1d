"""A headless Chromium on a page of the viewer: the one that is installed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from typing import Any

import numpy as np

WIDTH, HEIGHT = 900, 640  # small: the graphics are computed without a card
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
DRIVERS = ("chromedriver", "chromium-driver")
PATIENCE = 120.0  # s; a machine with other things to do takes its time
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    f"--window-size={WIDTH},{HEIGHT}",
)


def missing() -> str:
    """Why there is no browser here; empty: there is one."""
    if not any(map(shutil.which, PROGRAMS)):
        return "no chromium is installed"
    if not any(map(shutil.which, DRIVERS)):
        return "no chromedriver is installed"
    return ""


def first(names: tuple[str, ...]) -> str:
    return next(filter(None, map(shutil.which, names)), "")


def opened(address: str) -> Any:
    """A window on a page."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    for flag in FLAGS:
        options.add_argument(flag)
    options.binary_location = first(PROGRAMS)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    window = webdriver.Chrome(options=options, service=Service(first(DRIVERS)))
    window.get(address)
    return window


def text(window: Any) -> str:
    return window.find_element("tag name", "body").text


def until(happens: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """What `happens` gives as soon as it is true.

    Raises:
        AssertionError: it never is.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = happens()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError(f"in {seconds:g} s it did not happen")


def mouse(window: Any, kind: str, x: int, y: int, held: bool = True) -> None:
    """What the left button or the mouse does; again where the page is too slow."""
    from selenium.common.exceptions import TimeoutException

    event = {
        "type": kind,
        "x": x,
        "y": y,
        "button": "left" if held else "none",
        "buttons": int(held and kind != "mouseReleased"),
        "clickCount": int(kind != "mouseMoved"),
    }

    def sent() -> bool:
        try:
            window.execute_cdp_cmd("Input.dispatchMouseEvent", event)
        except TimeoutException:
            return False
        return True

    until(sent)


def pixel(window: Any, client: Any, place: np.ndarray) -> tuple[int, int]:
    """Where a point of the page's scene [3] is in the window."""
    camera = client.camera
    w, x, y, z = camera.wxyz
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    right, down, ahead = turn.T @ (place - camera.position)
    canvas = window.find_element("tag name", "canvas").rect
    focal = 0.5 * canvas["height"] / np.tan(0.5 * camera.fov)
    return (
        round(canvas["x"] + 0.5 * canvas["width"] + focal * right / ahead),
        round(canvas["y"] + 0.5 * canvas["height"] + focal * down / ahead),
    )


def field(window: Any, label: str) -> Any:
    """The box to type in that belongs to a label."""
    path = f"//label[normalize-space()='{label}']/ancestor::div[.//input][1]//input"
    return [x for x in window.find_elements("xpath", path) if x.is_displayed()][-1]


def press(window: Any, label: str) -> None:
    """Clicks a button, wherever the panel is scrolled to."""
    button = window.find_element("xpath", f"//button[normalize-space()='{label}']")
    window.execute_script("arguments[0].click()", button)
