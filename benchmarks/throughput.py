"""Physics steps per second beside C MuJoCo, standing and in training; contact error.

    python benchmarks/throughput.py [--tasks push door ...] [--json FILE] [--quick]

Standing: a character held on its soles, with nothing else in the scene. Training: what
the shipped policies meet (`states.visited`), scene by scene. C MuJoCo (one thread, all
threads) and ours step the same states under the same forces; ours with compliance is
the physics step of a training, PD and task included. The machine's speed drifts, so the
engines take turns and ratios are of medians. The rows are Markdown, for
docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

from dcc_jax import command, runtime

runtime.ensure()

import jax  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import states  # noqa: E402
import stepping  # noqa: E402
from contact_error import landing_errors  # noqa: E402

from dcc_jax.tasks import TASKS  # noqa: E402

THREADS = len(os.sched_getaffinity(0))
ENGINES = ("c_1_thread", "c_all_threads", "ours", "ours_compliance")
COLUMNS = (
    "states",
    "C, 1 thread",
    "C, all threads",
    "ours",
    "ours, compliance",
    "ours / C 1",
    "ours / C all",
    "compliance / C 1",
    "compliance / C all",
)


def measured(start: states.Start, rounds: int, naive: bool) -> dict[str, float]:
    """Steps per second of every engine, ratios, and how far the engines end apart.

    Args:
        start: the states.
        rounds: turns.
        naive: measure `vmap(mjx.step)` as well.
    """
    compliant = states.with_compliance(start)
    end, drive = compliant()
    job = states.job(start, drive)
    alone, theirs = stepping.ours(job), stepping.c_mujoco(job, THREADS)
    runs: dict[str, Callable] = {
        "c_1_thread": stepping.c_mujoco(job, 1),
        "c_all_threads": theirs,
        "ours": alone,
        "ours_compliance": compliant,
    }
    if naive:
        runs["mjx_naive"] = stepping.naive_mjx(job)
    rates = stepping.rates(runs, job.count, rounds)
    ratios = {
        f"ratio_{name}_{c}": rates[name] / rates[c]
        for name in rates
        if name not in ("c_1_thread", "c_all_threads")
        for c in ("c_1_thread", "c_all_threads")
    }
    apart = np.abs(np.asarray(end.body.qpos) - theirs()).max(axis=1)
    return {
        **{name: round(rate, 1) for name, rate in rates.items()},
        **{name: round(ratio, 3) for name, ratio in ratios.items()},
        "apart_median": float(np.median(apart)),
        "apart_p95": float(np.percentile(apart, 95)),
    }


def row(name: str, numbers: dict[str, float]) -> str:
    """A line of the table, rates in thousands."""
    cells = [f"{numbers[engine] / 1e3:.1f} k" for engine in ENGINES]
    cells += [
        f"{numbers[f'ratio_{ours}_{c}']:.2f}"
        for ours in ("ours", "ours_compliance")
        for c in ("c_1_thread", "c_all_threads")
    ]
    return f"| {' | '.join([name, *cells])} |"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--tasks",
        nargs="*",
        metavar="TASK",
        help=f"policies whose states to visit (all that ship: {', '.join(TASKS)})",
    )
    parser.add_argument(
        "--noise",
        type=float,
        metavar="DEGREES",
        help="of their actions (what they were trained with: 6, or 3)",
    )
    parser.add_argument("--json", help="write the numbers to this file")
    parser.add_argument(
        "--quick", action="store_true", help="few rounds and drops; push alone"
    )
    args = parser.parse_args()
    if args.tasks is None:
        args.tasks = ["push"] if args.quick else list(TASKS)
    return args


def main() -> None:
    """Parses the arguments, measures, prints, writes."""
    args = arguments()
    rounds, drops = (5, 4) if args.quick else (21, 16)
    per_device = 128 if jax.default_backend() == "cpu" else 8192
    count = per_device * len(jax.devices())
    report: dict[str, Any] = {
        "device": f"{len(jax.devices())} x {jax.devices()[0].device_kind}",
        "machine": f"{platform.machine()}, {THREADS} cores",
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "environments": count,
    }
    for name, value in report.items():
        print(f"{name:16s}{value}")
    print(f"\n| {' | '.join(COLUMNS)} |\n|---{'|--:' * (len(COLUMNS) - 1)}|")
    rates: dict[str, dict[str, float]] = {}
    for name in ["standing", *args.tasks]:
        begin = time.perf_counter()
        alone = name == "standing"
        start = (
            states.standing(count) if alone else states.visited(name, count, args.noise)
        )
        rates[name] = measured(start, rounds, naive=alone)
        print(row(name, rates[name]), flush=True)
        apart = rates[name]["apart_p95"]
        taken = time.perf_counter() - begin
        print(
            f"({name}: {taken:.0f} s; C and ours end {apart:.1e} apart)",
            file=sys.stderr,
        )
        if alone:
            report["landings"] = landing_errors(start.environment.scene, drops)
    report["rates"] = rates
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    report["peak_memory_mib"] = memory
    print()
    for name, value in report["landings"].items():
        print(f"{name:24s}{value:.1e}")
    print(f"{'peak_memory_mib':24s}{memory}")
    if args.json:
        with open(args.json, "w") as file:
            json.dump(report, file, indent=2)


if __name__ == "__main__":
    command.script(main)
