"""The stiffness that a moving character has at its hands, chest and head.

A force ramps up at a body, holds and lets go, while the trained policy balances and
walks. The yield is how far the body's centre of mass moves relative to the pelvis, in
the pelvis's frame, against the same episode without the force. It is compared with the
stiffness that Eq. (7) gives at the poses of that episode.
Letters: K trials, T control steps, E episodes.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from scipy.spatial.transform import Rotation

from dcc_jax import quat
from dcc_jax.character import CONTROL_RATE, Character, compose_scene
from dcc_jax.control.stiffness import softened_gains, stiffness
from dcc_jax.env import features
from dcc_jax.env.environment import Environment
from dcc_jax.env.observation import ALPHA_ENTRY
from dcc_jax.env.state import EnvState
from dcc_jax.evaluate import bootstrap
from dcc_jax.evaluate.bootstrap import Interval
from dcc_jax.learn.rollout import Policy
from dcc_jax.play.pull import PUSH, Hands, Pulled
from dcc_jax.play.runs import Run, make_environment

Array = jax.Array
Play = Callable[[Run, "Trials", float, int], tuple[np.ndarray, np.ndarray]]

BODIES = ("left_hand", "right_hand", "chest", "head")
NEWTONS = (20.0, 50.0, 100.0, 150.0)
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
LEVELS = (0.0, 0.16, 0.3, 0.5, 0.7, 0.8)
BEGIN, RAMP, HOLD = 4.0, 0.5, 2.5  # s
AVERAGED = 1.0  # s, the last of the hold: a stride of a walk
NEAR = 0.25
"""A trial whose stiffness is within this share of theory's delivers it (as the field
counts it)."""


@dataclass(frozen=True)
class Trials:
    """What is tried in one program: first every episode without a force."""

    episode: np.ndarray  # [K]
    body: np.ndarray  # [K] index into BODIES, -1: no force
    force: np.ndarray  # [K, 3] N, world

    @classmethod
    def of(cls, episodes: int) -> Trials:
        """Every body, direction and force in every episode."""
        rows = [(e, -1, np.zeros(3)) for e in range(episodes)]
        rows += [
            (e, b, n * d)
            for e, b, n, d in itertools.product(
                range(episodes), range(len(BODIES)), NEWTONS, DIRECTIONS
            )
        ]
        episode, body, force = zip(*rows, strict=True)
        return cls(np.array(episode), np.array(body), np.stack(force))


@dataclass(frozen=True)
class Drag:
    """Of one level of compliance, every trial with a force."""

    alpha: float
    body: np.ndarray  # [K] index into BODIES
    episode: np.ndarray  # [K]
    newtons: np.ndarray  # [K]
    measured: np.ndarray  # [K] N/m, force over the yield along it; NaN where it fell
    theory: np.ndarray  # [K] N/m, by Eq. (7) and the weights
    fell: np.ndarray  # [K] bool

    def share_near(self, bodies: tuple[str, ...]) -> Interval:
        """Of the trials at these bodies, those within `NEAR` of theory."""
        at = np.isin(self.body, [BODIES.index(b) for b in bodies]) & ~self.fell
        with np.errstate(invalid="ignore"):
            off = np.abs(self.measured[at] / self.theory[at] - 1.0)
        return bootstrap.share(off < NEAR)

    def median(self, body: str) -> tuple[float, float]:
        """Median stiffness at a body, N/m: measured, by theory."""
        at = (self.body == BODIES.index(body)) & ~self.fell
        return float(np.median(self.measured[at])), float(np.median(self.theory[at]))


def drag(
    run: Run, alpha: tuple[float, ...], episodes: int, seed: int = 0, **task: object
) -> list[Drag]:
    """Drags a run's character about at each level of compliance.

    Args:
        run: whose policy acts; a task's own disturbances are off.
        alpha: levels of compliance.
        episodes: of each trial, with other initial states and motions.
        seed: of everything that is drawn.
        task: other parameters of the run's task.

    Raises:
        ValueError: an alpha that the law cannot have, unknown parameters.
    """
    for level in alpha:
        run.config.env.compliance.check_alpha(level)
    changed = run.config.with_({f"task.{name}": value for name, value in task.items()})
    environment = make_environment(run, Pulled(changed.task.quiet()))
    trials = Trials.of(episodes)
    play = _program(environment)
    return [
        _measured(environment.scene.character, trials, level, run, play, seed)
        for level in alpha
    ]


def slope(drags: list[Drag], body: str) -> float:
    """Of log measured over log theoretical median stiffness at a body, over alpha."""
    found, expected = np.log(np.array([d.median(body) for d in drags])).T
    return float(np.polyfit(expected, found, 1)[0])


def _measured(
    character: Character, trials: Trials, alpha: float, run: Run, play: Play, seed: int
) -> Drag:
    q, ended = play(run, trials, alpha, seed)  # [T, K, 55], [K]
    q = q[-round(AVERAGED * CONTROL_RATE) :]
    pulled = trials.body >= 0
    body, force, episode = trials.body[pulled], trials.force[pulled], trials.episode
    alone = episode[pulled]  # where the same episode without a force is
    newtons = np.linalg.norm(force, axis=1)
    seen, turn = _from_pelvis(character, q)
    each = np.arange(len(body))
    away = seen[:, pulled][:, each, body] - seen[:, alone][:, each, body]
    along = np.einsum("tkji,kj->tki", turn[:, pulled], force)  # N, in its frame
    yields = np.sum(away * along, axis=-1).mean(axis=0) / newtons
    C = _compliances(character, q[:, ~pulled], alpha)
    f = along.mean(axis=0)
    expected = np.einsum("ki,kij,kj->k", f, C[alone, body], f) / newtons
    fell = ended[pulled] | ended[alone]
    with np.errstate(divide="ignore"):
        found = np.where(fell, np.nan, newtons / yields)
    return Drag(alpha, body, alone, newtons, found, newtons / expected, fell)


def _from_pelvis(character: Character, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of mass [T, K, bodies, 3] in the pelvis's frame, m, and its rotation
    [T, K, 3, 3], at coordinates [T, K, 55]."""
    model = compose_scene(character, floor=False)
    kinematics = features.Kinematics.of(model)
    at = [character.body_names.index(name) for name in BODIES]
    offset = jnp.array([model.body(name).ipos for name in BODIES], jnp.float32)

    @jax.jit
    def seen(q: Array) -> Array:
        pos_w, quat_w = features.body_poses(kinematics, q)
        point_w = pos_w[jnp.array(at)] + quat.rotate(quat_w[jnp.array(at)], offset)
        return quat.rotate(quat.inv(q[3:7]), point_w - q[:3])

    turn = Rotation.from_quat(q[..., 3:7].reshape(-1, 4), scalar_first=True)
    points = np.asarray(jax.vmap(jax.vmap(seen))(q))
    return points, turn.as_matrix().reshape(*q.shape[:2], 3, 3)


def _compliances(character: Character, q: np.ndarray, alpha: float) -> np.ndarray:
    """K_hat^-1 [E, bodies, 3, 3] in the pelvis's frame, mean over the poses [T, E, 55].

    Every fifth pose: a stride has a dozen.
    """
    model = compose_scene(character, floor=False)
    kp = softened_gains(character.kp, character.column_weight, alpha)
    found = np.zeros((q.shape[1], len(BODIES), 3, 3))
    poses = q[::5].astype(float)
    poses[..., :7] = model.qpos0[:7]
    for e, b in np.ndindex(*found.shape[:2]):
        point = model.body(BODIES[b]).ipos
        for pose in poses[:, e]:
            K = stiffness(model, pose, BODIES[b], point, kp)
            found[e, b] += np.linalg.inv(K) / len(poses)
    return found


def _program(environment: Environment) -> Play:
    """Plays all trials of a level; compiled once."""
    scene, steps = environment.scene, round((BEGIN + RAMP + HOLD) * CONTROL_RATE)
    devices = jax.devices()
    mesh = jax.make_mesh((len(devices),), ("env",), devices=devices)
    split, over_time = PartitionSpec("env"), PartitionSpec(None, "env")
    ids = np.array([scene.body(name) for name in BODIES])
    centres = np.array([scene.model.body_ipos[i] for i in ids])

    def reset(key: Array, body: Array, alpha: Array) -> EnvState:
        state = environment.reset(jax.random.fold_in(key, 0), alpha)
        at, place = jnp.asarray(ids)[body], jnp.asarray(centres, jnp.float32)[body]
        hands = state.task.hands
        hands = dataclasses.replace(
            hands,
            body=hands.body.at[PUSH].set(at),
            point=hands.point.at[PUSH].set(place),
        )
        return _with_hands(state, hands)

    def dragged(state: EnvState, force: Array) -> EnvState:
        share = jnp.clip((state.time - BEGIN) / RAMP, 0.0, 1.0)
        hands = state.task.hands
        force_w = hands.force_w.at[PUSH].set(share * force)
        return _with_hands(state, dataclasses.replace(hands, force_w=force_w))

    def episodes(
        policy: Policy,
        keys: Array,
        body: Array,
        force: Array,
        alpha: Array,
        told: Array,
    ) -> tuple[Array, Array]:
        def step(carry: tuple[EnvState, Array], time: Array):
            state, ended = carry
            action = policy.mean(state.obs.at[:, ALPHA_ENTRY].set(told))
            draws = jax.vmap(lambda key: jax.random.fold_in(key, time))(keys)
            state = jax.vmap(dragged)(state, force)
            state = jax.vmap(environment.step)(draws, state, action)
            ended = ended | state.terminated
            q = jax.vmap(scene.character_qpos)(state.body.qpos)
            return (state, ended), q

        start = jax.vmap(reset)(keys, body, alpha)
        carry = start, jnp.zeros(len(keys), bool)
        (_, ended), q = jax.lax.scan(step, carry, 1 + jnp.arange(steps))
        return q, ended

    program = jax.jit(
        jax.shard_map(
            episodes,
            mesh=mesh,
            in_specs=(PartitionSpec(), split, split, split, split, split),
            out_specs=(over_time, split),
            check_vma=False,
        )
    )

    def play(
        run: Run, trials: Trials, alpha: float, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        count = len(trials.body)
        filled = np.resize(np.arange(count), -(-count // len(devices)) * len(devices))
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(
            trials.episode[filled]
        )
        level = np.full(len(filled), alpha, np.float32)
        given = jax.device_put(
            (
                keys,
                np.maximum(trials.body[filled], 0),
                trials.force[filled].astype(np.float32),
                level,
                np.clip(level, *run.alphas),
            ),
            NamedSharding(mesh, split),
        )
        q, ended = program(run.policy, *given)
        return np.asarray(q)[:, :count], np.asarray(ended)[:count]

    return play


def _with_hands(state: EnvState, hands: Hands) -> EnvState:
    return dataclasses.replace(state, task=dataclasses.replace(state.task, hands=hands))
