"""What the viewer costs: start, control step, memory, growth, real time with a browser.

    python benchmarks/viewer.py [POLICY ...] [--minutes 1]
    python benchmarks/viewer.py [POLICY ...] --browser [--plain]

Each policy in a fresh process: seconds from the command to the first control step, ms
of a control step (33.3 are real time), the largest memory, and how much it grew over
the last nine tenths of that many minutes of the character's time.

With `--browser` a headless Chromium looks on. It draws without a graphics card on the
same cores, which is the worst case. Then the minutes are the clock's, and there are
the real-time factor, its least of half a second, and the pictures a second.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from dcc_jax import command

COLUMNS = ("start, s", "step, ms", "95 %, ms", "memory, GB", "growth, MB")
WATCHED = (
    "real time",
    "least",
    "step, ms",
    "95 %, ms",
    "pictures/s",
    "memory, GB",
    "growth, MB",
)
SETTLING = 10.0  # s, for the page to load and draw
FRAMES = """
const done = arguments[0], began = performance.now();
let frames = 0;
function count() {
  const passed = performance.now() - began;
  if (passed > 5000) return done(1000 * frames / passed);
  frames += 1;
  requestAnimationFrame(count);
}
requestAnimationFrame(count);
"""


def measured(name: str, minutes: float) -> dict[str, float]:
    """Of this process, which has done nothing else yet."""
    began = time.perf_counter()
    from dcc_jax import runtime

    runtime.ensure(quiet=True)
    import numpy as np

    from dcc_jax.play.program import Program
    from dcc_jax.play.runs import find_run
    from dcc_jax.play.simulation import Simulation

    run = find_run(name)
    simulation = Simulation(run, Program(run))
    simulation.step()
    start = time.perf_counter() - began
    steps = max(20, round(minutes * 60 * 30))
    seconds, early = [], 0.0
    for count in range(steps):
        simulation.step()
        seconds.append(simulation.step_seconds)
        if count == steps // 10:
            early = _resident()
    milliseconds = 1e3 * np.array(seconds)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "start, s": start,
        "step, ms": float(np.median(milliseconds)),
        "95 %, ms": float(np.percentile(milliseconds, 95)),
        "memory, GB": peak,
        "growth, MB": _resident() - early,
    }


def watched(name: str, minutes: float, plain: bool) -> dict[str, float]:
    """The same with a browser on the page."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "view"))
    import browser
    import numpy as np

    from dcc_jax import runtime
    from dcc_jax.view import server
    from dcc_jax.view.viewer import Viewer

    runtime.ensure(devices=1, quiet=True)
    page = server.start("127.0.0.1", server.free_port("127.0.0.1", 8600))
    viewer = Viewer(page, name, (name,))
    viewer.set_plain(plain)
    loop = threading.Thread(target=viewer.run, daemon=True)
    loop.start()
    window = browser.opened(f"http://127.0.0.1:{page.get_port()}")
    simulation = browser.until(lambda: viewer.simulation, 600.0)
    time.sleep(SETTLING)
    factors, seconds, early = [], [], 0.0
    end = time.perf_counter() + 60.0 * minutes
    while (left := end - time.perf_counter()) > 0.0:
        time.sleep(0.5)
        factors.append(viewer.real_time_factor)
        seconds.append(simulation.step_seconds)
        if not early and left < 0.9 * 60.0 * minutes:
            early = _resident()
    growth = _resident() - early
    pictures = window.execute_async_script(FRAMES)
    window.quit()
    viewer.close()
    loop.join()
    page.stop()
    return {
        "real time": float(np.mean(factors)),
        "least": min(factors),
        "step, ms": 1e3 * float(np.median(seconds)),
        "95 %, ms": 1e3 * float(np.percentile(seconds, 95)),
        "pictures/s": pictures,
        "memory, GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "growth, MB": growth,
    }


def _resident() -> float:
    """MB of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy", nargs="*", help="all that ship, if none is named")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--browser", action="store_true", help="a browser looks on")
    parser.add_argument("--plain", action="store_true", help="no shadows, no tiles")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.one:
        name, minutes = options.policy[0], options.minutes
        if options.browser:
            print(json.dumps(watched(name, minutes, options.plain)))
        else:
            print(json.dumps(measured(name, minutes)))
        return
    columns = WATCHED if options.browser else COLUMNS
    print(f"| policy | {' | '.join(columns)} |\n|---|{'--:|' * len(columns)}")
    for name in options.policy or _shipped():
        command = [sys.executable, __file__, name, "--one"]
        command += ["--minutes", str(options.minutes)]
        command += ["--browser"] * options.browser + ["--plain"] * options.plain
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        rows = [line for line in done.stdout.splitlines() if line.startswith("{")]
        found = json.loads(rows[-1])
        cells = [f"{found[column]:.2f}" for column in columns]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _shipped() -> list[str]:
    from dcc_jax.character import asset_path

    return sorted(p.parent.name for p in asset_path("policies").glob("*/policy.npz"))


if __name__ == "__main__":
    command.script(main)
