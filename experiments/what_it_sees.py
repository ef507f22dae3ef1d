"""What a run's discriminator judges by: of clips, and of what the policy does.

    python experiments/what_it_sees.py runs/push [--steps 60]

The environments of the run's last checkpoint go on, with the policy that the run gives,
once with the mean action, once with the exploration of its training. The first table
has the score, the share that is judged right, and r_q of Eq. (13); balanced is the mean
of the clips' share and of theirs. The second says what of a pair it judges by: the
score of the nearest pair of the clips, less that of the policy's, divided among the
numbers that it sees by integrated gradients (Sundararajan 2017). No instance noise.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from dcc_jax import command, runtime

if __name__ == "__main__":
    runtime.ensure()

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.character import BODIES
from dcc_jax.env import rewards
from dcc_jax.env.environment import Environment
from dcc_jax.env.features import BODY_FEATURE_SIZE, FEATURE_SIZE
from dcc_jax.env.pairs import SEEN_SIZE
from dcc_jax.learn import discriminator, learner
from dcc_jax.learn.discriminator import Pairs
from dcc_jax.learn.rollout import Actors, rollout
from dcc_jax.learn.state import TrainState
from dcc_jax.play.runs import Run, find_run, make_environment
from dcc_jax.training import checkpoint

Array = jax.Array
COUNT = 4096  # pairs of each kind
STILL = 1e-6  # degrees of exploration, as good as none
KINDS = {
    "positions": slice(0, 3),
    "velocities": slice(3, 6),
    "columns": slice(6, 12),
    "their rates": slice(12, BODY_FEATURE_SIZE),
}
"""Of a body's numbers."""


def restored(run: Run, environment: Environment, folder: Path) -> TrainState:
    """The last checkpoint of a run.

    Raises:
        ValueError: there is none, or the run has no discriminator.
    """
    if environment.tracks_reference:
        raise ValueError(f"{folder} was taught by tracking: it has no discriminator")
    mesh = learner.make_mesh(run.config.train, devices=1)
    init = learner.make_init(environment, run.config, mesh, start=run.policy)
    template = jax.eval_shape(init, jax.random.key(0), None)
    found = checkpoint.restore_latest(folder, template, lambda text: print(text))
    if found is None:
        raise ValueError(f"{folder} has no checkpoint; policies that ship have none")
    return jax.tree.map(jnp.asarray, found[1])


def policy_pairs(
    run: Run, environment: Environment, state: TrainState, degrees: float, steps: int
) -> Pairs:
    """What the policy does with so much exploration, [COUNT, ...], after as long."""
    actors = Actors(run.policy, state.agent.value.params, None)
    ppo = replace(run.config.ppo, sigma_degrees=degrees)
    act = jax.jit(
        lambda key, running: rollout(key, environment, actors, running, steps, ppo, 128)
    )
    before, now, drawn = jax.random.split(jax.random.key(0), 3)
    taken = act(now, act(before, state.running).running)
    pairs = taken.transitions.pairs
    step, env = jax.random.randint(
        drawn, (2, COUNT), 0, np.reshape(pairs.s.shape[:2], (2, 1))
    )
    return jax.tree.map(lambda x: x[step, env], pairs)


def judged(run: Run, state: TrainState, sets: dict[str, Array]) -> str:
    """The first table, of inputs [N, W] by name; the clips' are the first."""
    lines = ["| | score | judged right | balanced | r_q |", "|---|--:|--:|--:|--:|"]
    of_clips = None
    for name, x in sets.items():
        score = discriminator.score(state.disc.params, x)
        right = float(jnp.mean((score > 0.0) == (of_clips is None)))
        balanced = "-" if of_clips is None else f"{0.5 * (right + of_clips):.0%}"
        of_clips = right if of_clips is None else of_clips
        r_q = float(jnp.mean(rewards.pose_reward(score, run.config.env.reward)))
        mean = float(jnp.mean(score))
        lines.append(f"| {name} | {mean:.2f} | {right:.0%} | {balanced} | {r_q:.2f} |")
    return "\n".join(lines)


def parts(state: TrainState, policy: Array, clips: Array) -> dict[str, float]:
    """What of the difference in score each kind of number accounts for, by name."""
    square = jnp.sum(policy**2, 1)[:, None] + jnp.sum(clips**2, 1)
    near = clips[jnp.argmin(square - 2.0 * policy @ clips.T, axis=1)]
    slope = jax.grad(lambda x: jnp.sum(discriminator.score(state.disc.params, x)))
    along = (np.arange(16) + 0.5) / 16.0
    mean = sum(slope(policy + t * (near - policy)) for t in along) / len(along)
    share = np.asarray(jnp.mean(mean * (near - policy), axis=0))
    seen = share[:SEEN_SIZE] + share[SEEN_SIZE : 2 * SEEN_SIZE]
    bodies = seen[:FEATURE_SIZE].reshape(len(BODIES), BODY_FEATURE_SIZE)
    found = {name: float(bodies[:, part].sum()) for name, part in KINDS.items()}
    return found | {"sliding soles": float(seen[FEATURE_SIZE:].sum())}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN_DIR")
    parser.add_argument("--steps", type=int, default=60, help="control steps (60)")
    options = parser.parse_args()
    if options.steps < 1:
        parser.error(f"--steps must be 1 or more, got {options.steps}")
    run = find_run(options.run)
    environment = make_environment(run)
    state = restored(run, environment, options.run)
    config, normal = run.config, state.feature_normalizer
    spans = jnp.full(COUNT, config.disc.span, jnp.int32)
    shown = {"clips": Pairs(*environment.expert_pairs(jax.random.key(1), spans))}
    explored = {"the mean action": STILL, "with exploration": config.ppo.sigma_degrees}
    for name, degrees in explored.items():
        given = run, environment, state, degrees
        shown[name] = policy_pairs(*given, options.steps)
    sets = {
        name: discriminator.inputs(normal, pairs, config.disc)
        for name, pairs in shown.items()
    }
    print(judged(run, state, sets))
    clips = sets.pop("clips")
    found = {name: parts(state, x, clips) for name, x in sets.items()}
    kinds = list(next(iter(found.values())))
    print(f"\n| it judges by | {' | '.join(kinds)} |\n|---{'|--:' * len(kinds)}|")
    for name, shares in found.items():
        cells = [f"{value:.2f}" for value in shares.values()]
        print(f"| {name} | {' | '.join(cells)} |")
    sys.stdout.flush()


if __name__ == "__main__":
    command.script(main)
