"""How near to its clips a motion is that goes where it is told, beside the planner's.

    python experiments/style_by_speed.py locomotion [--episodes 64] [--alpha 0]

Clips are steady strides of a few speeds, mostly straight ahead. Who is told to change
speed and to turn cannot always look like one of them. So the policy stands beside a
motion without physics: the package's loops, blended by `motion.planner` along paths of
the same gaits. Both are measured alike, `style/nearest` by the speed of the path and
until a fall. The last row has 95 % intervals over episodes, less those that fall in
their first control step.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()


import jax
import jax.numpy as jnp
import numpy as np
from commanded import asked

from dcc_jax.character import CONTROL_DT, CONTROL_RATE, asset_path
from dcc_jax.env import expert
from dcc_jax.env.environment import Environment
from dcc_jax.evaluate import bootstrap
from dcc_jax.learn import style
from dcc_jax.motion import paths, planner
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.paths import Gaits, Motion
from dcc_jax.motion.reference import References, RefState, make_references
from dcc_jax.play.runs import Run, make_environment
from dcc_jax.tasks.locomotion import Locomotion

Array = jax.Array
# Of pairs [T, N, E] in m, the path's speed [T, N] in m/s, and whether nobody has
# fallen yet [T, N].
Seen = tuple[Array, Array, Array]
Shape = tuple[int, int]  # control steps T, episodes N
EDGES = (0.0, 0.05, 0.6, 1.0, 1.4, 1.8, 2.2, 2.7, 3.1)  # m/s


def policy(
    run: Run, environment: Environment, alpha: float, shape: Shape, key: Array
) -> Seen:
    """What the mean action does in episodes of T control steps."""
    begin_key, step_key = jax.random.split(key)

    def step(state: Any, keys: Array) -> tuple[Any, Seen]:
        action = run.policy.mean(state.obs)
        after = jax.vmap(environment.step)(keys, state, action)
        pair = environment.style_coordinates(after.previous_features, after.features)
        return after, (pair, after.task.motion.speed, ~after.terminated)

    @jax.jit
    def episodes(begin: Array, keys: Array) -> Seen:
        reset = jax.vmap(lambda key: environment.reset(key, jnp.asarray(alpha)))
        return jax.lax.scan(step, reset(begin), keys)[1]

    begin = jax.random.split(begin_key, shape[1])
    points, speed, up = episodes(begin, jax.random.split(step_key, shape))
    return points, speed, jnp.cumprod(up, axis=0).astype(bool)


def planned(
    gaits: Gaits, loops: References, environment: Environment, shape: Shape, key: Array
) -> Seen:
    """What blended strides look like along such paths."""
    strides = planner.strides(loops)
    tables, weights = environment.mechanics, environment.weights
    as_seen = partial(expert.of_pose, tables, weights=weights)

    def begun(at_key: Array, motion_key: Array) -> tuple[RefState, Motion]:
        at = planner.first_reference(at_key, loops, gaits, stands=False)
        return at, planner.first_motion(motion_key, gaits, at)

    def one(carry: tuple[RefState, Motion], key: Array) -> tuple[RefState, Motion]:
        at, motion = carry
        motion = paths.go_on(key, gaits, motion)
        return planner.go_on(loops, strides, motion, at, CONTROL_DT), motion

    def step(carry: Any, keys: Array) -> tuple[Any, tuple[Array, Array]]:
        at, motion = jax.vmap(one)(carry, keys)
        return (at, motion), (
            jax.vmap(as_seen)(at.qpos, at.qpos_previous),
            motion.speed,
        )

    @jax.jit
    def episodes(begin: tuple[Array, Array], keys: Array) -> tuple[Array, Array]:
        _, (seen, speed) = jax.lax.scan(step, jax.vmap(begun)(*begin), keys)
        return environment.style_coordinates(seen[:-1], seen[1:]), speed[1:]

    at_key, motion_key, step_key = jax.random.split(key, 3)
    begin = jax.random.split(at_key, shape[1]), jax.random.split(motion_key, shape[1])
    keys = jax.random.split(step_key, (shape[0] + 1, shape[1]))
    points, speed = episodes(begin, keys)
    return points, speed, jnp.ones(speed.shape, bool)


def distances(environment: Environment, seen: Seen) -> np.ndarray:
    """To the nearest pair of the clips [T, N] in mm; NaN after a fall."""
    points, _, up = seen
    reference = style.make_reference(environment)
    found = jax.lax.map(lambda x: style.nearest(reference, x), points)
    return np.where(up, 1e3 * np.asarray(found), np.nan)


def rows(names: tuple[str, ...], all_seen: list[Seen], all_mm: list[np.ndarray]) -> str:
    """The table."""
    lines = [
        f"| speed of the path, m/s | {' | '.join(f'{n}, mm' for n in names)} |",
        "|--:" * (1 + len(names)) + "|",
    ]
    for low, high in pairwise(EDGES):
        cells = []
        for (_, speed, _), mm in zip(all_seen, all_mm, strict=True):
            band = (np.asarray(speed) >= low) & (np.asarray(speed) < high)
            inside = mm[band & np.isfinite(mm)]
            cells.append(f"{inside.mean():.0f}" if inside.size else "-")
        lines.append(f"| {low:g} to {high:g} | {' | '.join(cells)} |")
    cells = []
    for mm in all_mm:
        of_episode = np.nanmean(mm[:, np.isfinite(mm[0])], axis=0)
        mean = bootstrap.mean(of_episode, bootstrap.draws(len(of_episode)))
        cells.append(f"{mean.value:.1f} [{mean.low:.1f}, {mean.high:.1f}]")
    return "\n".join([*lines, f"| all | {' | '.join(cells)} |"])


def main() -> None:
    options, run, task = asked(__doc__ or "", Locomotion, episodes=64)
    environment = make_environment(run)
    clips = [load_clip(asset_path(f"motions/{name}.npz")) for name in planner.LOOPS]
    loops = make_references(clips)
    shape = round(options.seconds * CONTROL_RATE), options.episodes
    ours, theirs = jax.random.split(jax.random.key(options.seed))
    seen = [
        policy(run, environment, options.alpha, shape, ours),
        planned(task.gaits, loops, environment, shape, theirs),
    ]
    apart = [distances(environment, x) for x in seen]
    print(rows((str(options.run), "the planner"), seen, apart))


if __name__ == "__main__":
    command.script(main)
