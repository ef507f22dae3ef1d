"""What the physics step of a training is made of, by leaving parts out in turns.

    python benchmarks/substep.py [TASK ...] [--rounds 60]

The states are those that the shipped policy visits in training. First the step as it
trains; then without the sums of what is logged, without the displacement u as well,
without the task's forces, without PD: what is left is physics. A part costs what the
step gets faster without it. One device, microseconds of a core.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any
from unittest import mock

from dcc_jax import command, runtime

runtime.ensure(devices=1)

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import states  # noqa: E402

from dcc_jax.env import metrics, substep  # noqa: E402
from dcc_jax.env.state import Substep  # noqa: E402

COUNT = 128  # environments
PARTS = ("sums of what is logged", "displacement u", "forces of the task", "PD")


def compiled(start: states.Start, missing: int) -> Callable[[], Any]:
    """The physics steps of a control step without the first few of the parts."""
    environment = start.environment
    side, forces = environment.side, environment.task.forces

    def steps(carry: Substep, plan: Any) -> Substep:
        def step(carry: Substep, _: None) -> tuple[Substep, None]:
            ((after, _forces),) = substep.physics_step([side], [carry], [plan])
            return after, None

        return jax.lax.scan(step, carry, None, length=start.steps)[0]

    def no_forces(scene: Any, state: Any, *rest: Any) -> Any:
        shape = jax.eval_shape(lambda s: forces(scene, s, *rest)[1], state)
        return state, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)

    without = (
        mock.patch.object(metrics, "add", lambda sums, *_: sums),
        mock.patch.object(
            substep.Side, "displaced", lambda _, carry, *__: carry.displacement
        ),
        mock.patch.object(type(environment.task), "forces", staticmethod(no_forces)),
        mock.patch.object(substep.Side, "torque", lambda *_: jnp.zeros(42)),
    )
    for part in without[:missing]:
        part.start()
    program = jax.jit(jax.vmap(steps)).lower(start.carry, start.plan).compile()
    mock.patch.stopall()
    return lambda: jax.block_until_ready(program(start.carry, start.plan))


def medians(runs: list[Callable[[], Any]], rounds: int, steps: int) -> list[float]:
    """Microseconds of a step, of runs that take turns."""
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, times in zip(runs, seconds, strict=True):
            began = time.perf_counter()
            run()
            times.append(time.perf_counter() - began)
    return [1e6 * statistics.median(times) / steps for times in seconds]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", nargs="*", default=["push"], help="(push)")
    parser.add_argument("--rounds", type=int, default=60)
    options = parser.parse_args()
    print(f"| microseconds | the step | {' | '.join(PARTS)} | physics | u, share |")
    print("|---" + "|--:" * (len(PARTS) + 3) + "|")
    for name in options.task:
        start = states.visited(name, COUNT, None)
        runs = [compiled(start, missing) for missing in range(len(PARTS) + 1)]
        times = medians(runs, options.rounds, COUNT * start.steps)
        parts = [more - less for more, less in pairwise(times)]
        numbers = [f"{x:.1f}" for x in (times[0], *parts, times[-1])]
        share = parts[PARTS.index("displacement u")] / times[0]
        print(f"| {name} | {' | '.join(numbers)} | {share:.0%} |", flush=True)


if __name__ == "__main__":
    command.script(main)
