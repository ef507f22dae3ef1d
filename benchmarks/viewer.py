"""What the viewer's simulation costs: start, control step, memory, growth.

    python benchmarks/viewer.py [POLICY ...] [--minutes 1]

Each policy in a fresh process: seconds from the command to the first control step, ms
of a control step (33.3 are real time), the largest memory, and how much it grew over
the last nine tenths of that many minutes of the character's time. No browser.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

COLUMNS = ("start, s", "step, ms", "95 %, ms", "memory, GB", "growth, MB")


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


def _resident() -> float:
    """MB of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy", nargs="*", help="all that ship, if none is named")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.one:
        print(json.dumps(measured(options.policy[0], options.minutes)))
        return
    names = options.policy or _shipped()
    print(f"| policy | {' | '.join(COLUMNS)} |\n|---|{'--:|' * len(COLUMNS)}")
    for name in names:
        command = [sys.executable, __file__, name, "--one", "--minutes"]
        done = subprocess.run(
            [*command, str(options.minutes)], capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(done.stderr)
        found = json.loads(done.stdout.splitlines()[-1])
        cells = [f"{found[column]:.1f}" for column in COLUMNS]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _shipped() -> list[str]:
    from dcc_jax.character import asset_path

    return sorted(p.parent.name for p in asset_path("policies").glob("*/policy.npz"))


if __name__ == "__main__":
    main()
