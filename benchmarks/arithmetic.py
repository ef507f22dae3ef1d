"""How far the kernels are from what the arithmetic in them takes on this CPU.

    python benchmarks/arithmetic.py [TASK ...] [--rounds 40]

Operations are counted, not estimated: the kernels are compiled once more with numbers
that count (`counted.h`), and make the same physics step in the states that a training
visits. A sum, a product, a quotient, a comparison is one; a multiply-add is two. Bytes
are those that XLA hands a kernel and gets back, once each. Beside them the time that
one core takes for the physics step, and what it would take at its own peak (`peak.cc`):
multiply-adds out of registers, and a copy of the size of a batch.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import json
import math
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from dcc_jax import command, runtime

runtime.ensure(devices=1, quiet=True)

import jax  # noqa: E402
import states  # noqa: E402
import stepping  # noqa: E402

from dcc_jax import native  # noqa: E402

COUNT = 128  # environments
COLUMNS = (
    "states",
    "operations, kinematics",
    "operations, solver",
    "bytes",
    "summing at peak",
    "copying",
    "the step",
    "ratio",
)
KERNELS = {"kinematics": "dcc_kinematics", "newton": "dcc_newton"}
HERE = Path(__file__).parent
COUNTER = 'extern "C" uint64_t counted_{0}() {{ return operations; }}\n'


def counting(folder: Path) -> Path:
    """The kernels with lanes that count."""
    for path in native.SOURCES.iterdir():
        shutil.copy(path, folder)
    shutil.copy(HERE / "counted.h", folder)
    lanes = (folder / "lanes.h").read_text()
    kept = [
        line
        for line in lanes.splitlines()
        if not re.match(r"typedef .* (V|I) __attr|inline V choose", line)
    ]
    first = next(i for i, line in enumerate(kept) if line.startswith("typedef"))
    kept.insert(first, '#include "counted.h"')
    (folder / "lanes.h").write_text("\n".join(kept) + "\n")
    for name in KERNELS:
        with (folder / f"{name}.cc").open("a") as file:
            file.write(COUNTER.format(name))
    library = folder / "counting.so"
    native.build(folder.glob("*.cc"), library)
    return library


def step(start: states.Start) -> stepping.Job:
    """One physics step of the training, as the physics alone sees it."""
    compliant = states.with_compliance(dataclasses.replace(start, steps=1))
    return states.job(start, compliant()[1])


def moved(job: stepping.Job) -> dict[str, float]:
    """Bytes of an environment in and out of each kernel."""
    steps = jax.vmap(stepping.our_steps(job))
    program = stepping.placed(steps, job.states, job.drive)[0].as_text()
    assert program is not None
    return {name: _bytes(program, target) for name, target in KERNELS.items()}


def _bytes(program: str, target: str) -> float:
    """Of the arrays that a custom call is handed and gives back, an environment."""
    (line,) = [x for x in program.splitlines() if f'custom_call_target="{target}"' in x]
    results, rest = line.split(" custom-call(")
    names = re.findall(r"%[\w.\-]+", rest.split(")")[0])
    kinds = [results, *(_result(program, name) for name in names)]
    shapes = re.findall(r"f32\[([\d,]*)\]", " ".join(kinds))
    return 4.0 * sum(math.prod(map(int, x.split(","))) for x in shapes) / COUNT


def _result(program: str, name: str) -> str:
    found = re.search(rf"{re.escape(name)} = (\S+)", program)
    assert found is not None
    return found[1]


def count(tasks: list[str]) -> dict[str, dict[str, float]]:
    """Operations of an environment in one physics step, by task and kernel."""
    with tempfile.TemporaryDirectory() as folder:
        path = counting(Path(folder))
        native._made = lambda: path  # pyright: ignore[reportAttributeAccessIssue]
        library = ctypes.CDLL(str(path))
        counters = {name: getattr(library, f"counted_{name}") for name in KERNELS}
        for counter in counters.values():
            counter.restype = ctypes.c_uint64
        found: dict[str, dict[str, float]] = {}
        for task in tasks:
            run = stepping.ours(step(states.visited(task, COUNT, None)))
            before = {name: counter() for name, counter in counters.items()}
            run()
            found[task] = {
                name: (counter() - before[name]) / COUNT
                for name, counter in counters.items()
            }
        return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", nargs="*", default=["push"], help="(push)")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--count", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.count:
        print(json.dumps(count(options.task)))
        return
    # Another process: a kernel's name can be taken only once.
    command = [sys.executable, __file__, *options.task, "--count"]
    told = subprocess.run(command, check=True, capture_output=True, text=True)
    counted = json.loads(told.stdout.splitlines()[-1])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "peak.so"
        native.build([HERE / "peak.cc"], path)
        library = ctypes.CDLL(str(path))
    library.peak_operations.restype = library.copied_bytes.restype = ctypes.c_double
    library.copied_bytes.argtypes = [ctypes.c_int64]
    peak = statistics.median(library.peak_operations() for _ in range(3))
    print(f"peak of a core: {peak / 1e9:.0f} G operations/s")
    print(f"| {' | '.join(COLUMNS)} |\n|---{'|--:' * (len(COLUMNS) - 1)}|")
    for task in options.task:
        start = states.visited(task, COUNT, None)
        size = sum(moved(step(start)).values())
        operations = sum(counted[task].values())
        whole = states.job(start, states.with_compliance(start)()[1])
        ours = {"ours": stepping.ours(whole)}
        took = 1.0 / stepping.rates(ours, whole.count, options.rounds)["ours"]
        summing = operations / peak
        copying = size / library.copied_bytes(int(size * COUNT))
        cells = [f"{counted[task][name] / 1e3:.1f} k" for name in KERNELS]
        cells += [f"{size / 1e3:.1f} k"]
        cells += [f"{1e6 * x:.2f} us" for x in (summing, copying, took)]
        print(f"| {' | '.join([task, *cells, f'{took / (summing + copying):.0f}'])} |")


if __name__ == "__main__":
    command.script(main)
