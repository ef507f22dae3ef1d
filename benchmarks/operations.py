"""Where an update goes, operation by operation, in XLA's own trace.

    python benchmarks/operations.py [TASK] [--updates 6] [--top 40]

A row is a group of compiled operations that come from the same line of our program:
microseconds for each tuple, and the share of all. Kernels are `ffi_call`;
what XLA made itself, such as copies, has no line. Environments begin anew and the
policy is untrained. One device with the environments of one of two.
"""

from __future__ import annotations

import argparse
import collections
import gzip
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dcc_jax import command, runtime

runtime.ensure(devices=1)

import jax  # noqa: E402

from dcc_jax import tasks  # noqa: E402
from dcc_jax.config import make_config  # noqa: E402
from dcc_jax.learn import learner  # noqa: E402

# What is not one operation: loops, branches, the runtime and Python.
GROUPS = re.compile(
    r"\$|end: |(while|cond|conditional|call)[.\d]*$|.*(Execut|Pjit|Await|::)"
)
WARM_UP = 3  # updates before the trace


def lines_of(program: Any) -> dict[str, str]:
    """Where in our program each operation comes from, as XLA has noted it."""
    named = re.finditer(r'%([\w.-]+) = .*?op_name="([^"]*)"', program.as_text())
    return {found[1]: found[2] for found in named}


def traced(run: Callable[[], None]) -> collections.Counter[str]:
    """Microseconds of every operation in a call of `run`."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            run()
        (file,) = Path(folder).rglob("*.trace.json.gz")
        events = json.loads(gzip.decompress(file.read_bytes()))["traceEvents"]
    found: collections.Counter[str] = collections.Counter()
    for event in events:
        if event.get("ph") == "X" and not GROUPS.match(event["name"]):
            found[event["name"]] += event["dur"]
    return found


def group(name: str, lines: dict[str, str]) -> str:
    """What an operation is counted as."""
    line = lines.get(name, "(XLA's own)").removeprefix("jit(update)/")
    line = re.sub(r"(while/body/|closed_call/)+", "loop/", line)
    return f"{line} (kernel)" if name.startswith("ffi_call") else line


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", nargs="?", default="push", choices=tasks.TASKS)
    parser.add_argument("--updates", type=int, default=6)
    parser.add_argument("--top", type=int, default=40, help="rows (40)")
    options = parser.parse_args()
    config = make_config(options.task, preset="cpu").with_({"train.num_envs": 128})
    environment = tasks.make_environment(config.task, config.env)
    mesh = learner.make_mesh(config.train)
    state = learner.make_init(environment, config, mesh)(jax.random.key(0), None)
    program = learner.make_update(environment, config, mesh).lower(state).compile()  # pyright: ignore[reportFunctionMemberAccess]

    def run(updates: int) -> None:
        nonlocal state
        for _ in range(updates):
            state, _ = program(state)
        jax.block_until_ready(state)

    run(WARM_UP)
    times = traced(lambda: run(options.updates))
    lines, grouped = lines_of(program), collections.Counter()
    for name, time in times.items():
        grouped[group(name, lines)] += time
    tuples, total = options.updates * config.train.tuples_per_update, grouped.total()
    print(f"{total / tuples:.1f} us a tuple")
    for name, time in grouped.most_common(options.top):
        print(f"{time / tuples:7.2f} {time / total:6.1%}  {name}")


if __name__ == "__main__":
    command.script(main)
