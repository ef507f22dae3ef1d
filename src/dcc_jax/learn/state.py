"""Everything a run is, and how much of it is simulated.

Letters: B environments of this device, D devices.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.env.rewards import RewardConfig
from dcc_jax.learn import discriminator, networks, normalizer, ppo, warm_start
from dcc_jax.learn.discriminator import DiscriminatorConfig
from dcc_jax.learn.exchange import all_gather_tree
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.rollout import Environment, Incident, Policy, Running

Array = jax.Array
AXIS = "env"  # mesh axis over which the environments are sharded

_EXPERT_SAMPLE = 4096


@dataclass(frozen=True)
class TrainConfig:
    """How much is simulated, and what is kept."""

    num_envs: int = 256
    """Environments over all devices; 128 a core fill the cache of a CPU (measured)."""

    unroll_length: int = 32
    """Control steps of every environment in an update; the paper collects 2048 tuples
    (Sec. 5.1)."""

    chunk_size: int | None = None
    """Environments that a device steps at once; None: as many up to 128 as come out
    even on a CPU, all elsewhere."""

    total_tuples: int = 20_000_000
    """Training ends after as many (s, a, r, s'); the paper has 20-80 M (Sec. 5.1)."""

    warm_start_steps: int = 500
    """Supervised steps in which the policy learns to lead along the clips before its
    first update; 0: it begins with random weights, as in the paper."""

    start_from: str | None = None
    """A run directory or the name of a policy that ships, whose policy this training
    begins with, in place of the warm start. The value function begins anew."""

    policy_waits: int = 20
    """Updates in which the value function learns alone, where the policy begins with a
    warm start or another's: what it learned would be lost to a value function that
    knows nothing yet (not the paper's)."""

    checkpoint_interval: int = 50
    """Updates between checkpoints; one is also written at the end and on a signal."""

    averaged_updates: int = 100
    """The policy that a run gives has the mean of the parameters after every update,
    and beyond so many updates an exponential mean of that length (not the paper's). 1:
    the parameters after the last update."""

    keep_checkpoints: int = 3
    """The last few that stay on disk."""

    def __post_init__(self) -> None:
        for name in (
            "num_envs",
            "unroll_length",
            "total_tuples",
            "checkpoint_interval",
            "keep_checkpoints",
            "averaged_updates",
        ):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(f"train.{name} must be 1 or more, got {value}")
        for name in ("warm_start_steps", "policy_waits"):
            value = getattr(self, name)
            if value < 0:
                raise ValueError(f"train.{name} must be 0 or more, got {value}")
        for name in ("policy_waits", "averaged_updates"):
            value = getattr(self, name)
            if value >= 2**31:  # as an int32 the device counts updates
                raise ValueError(f"train.{name} must be less than 2^31, got {value}")
        if self.chunk_size is not None and self.chunk_size < 1:
            raise ValueError(
                f"train.chunk_size must be 1 or more, or None, got {self.chunk_size}"
            )

    @property
    def waits(self) -> int:
        """Updates that the policy waits, none where it begins with random weights."""
        begins_anew = self.start_from is None and not self.warm_start_steps
        return 0 if begins_anew else self.policy_waits

    @property
    def tuples_per_update(self) -> int:
        """Transitions of one update, all environments together."""
        return self.num_envs * self.unroll_length


class HasReward(Protocol):
    """The part of an environment's section that the learner reads."""

    @property
    def reward(self) -> RewardConfig: ...


class LearnerConfig(Protocol):
    """The sections the learner reads."""

    @property
    def env(self) -> HasReward: ...
    @property
    def ppo(self) -> PpoConfig: ...
    @property
    def disc(self) -> DiscriminatorConfig: ...
    @property
    def train(self) -> TrainConfig: ...


@flax.struct.dataclass
class TrainState:
    """Everything a run is: resuming from it continues bit for bit."""

    agent: ppo.Agent
    averaged: networks.Mlp  # the policy's parameters, their mean over updates
    disc: networks.Network
    obs_normalizer: normalizer.Normalizer  # of the policy's observation
    feature_normalizer: normalizer.Normalizer  # of the discriminator's features
    running: Running  # environments, [B, ...]
    alpha: Array | None  # [] compliance of this run, or None: the environment's own
    key: Array  # [] of all that is still to be drawn
    update: Array  # [] int32 updates done
    nan_count: Array  # [] int32 environments that ever broke
    episode_length: Array  # [] mean steps of the episodes that ended last
    fall_rate: Array  # [] share of them that ended by termination


@flax.struct.dataclass
class UpdateReport:
    """What an update tells the outside."""

    metrics: dict[str, Array]  # [] each
    incident: Incident  # [D, ...]


def init_state(
    key: Array,
    alpha: Array | None,
    environment: Environment,
    config: LearnerConfig,
    local_envs: int,
    start: Policy | None = None,
) -> TrainState:
    """A run before its first update, seen from one device of the mesh axis.

    Args:
        key: the run's; consumed. Equal on all devices.
        alpha: [] level of compliance, or None: the environment's own.
        environment: of the task.
        config: sizes.
        local_envs: B.
        start: the policy it begins with; None: a warm start, or random weights.
    """
    key, agent_key, disc_key, reset_key, expert_key = jax.random.split(key, 5)
    lessons = 0 if start is not None else config.train.warm_start_steps
    a_lesson = max(warm_start.SAMPLES // jax.lax.axis_size(AXIS), 1)
    running, obs, action = _begun(
        of_device(reset_key),
        environment,
        alpha,
        local_envs,
        lessons * a_lesson,
        config.disc.span,
    )
    agent = ppo.init_agent(
        agent_key, environment.observation_size, environment.action_size, config.ppo
    )
    # As much as an update sees, so that what comes later counts as much.
    seen = obs[: config.train.unroll_length * local_envs]
    obs_normalizer = normalizer.pooled(all_gather_tree(normalizer.moments(seen), AXIS))
    if lessons:
        obs = normalizer.normalize(obs_normalizer, obs)
        obs, action = (x.reshape(lessons, -1, x.shape[-1]) for x in (obs, action))
        agent = warm_start.warm_start(agent, obs, action, config.ppo, AXIS)
    if start is not None:
        policy = dataclasses.replace(agent.policy, params=start.params)
        agent = dataclasses.replace(agent, policy=policy)
        obs_normalizer = start.normalizer
    s, _, _ = environment.expert_pairs(expert_key, jnp.ones(_EXPERT_SAMPLE, jnp.int32))
    width = 2 * environment.feature_size + environment.condition_size
    disc = networks.init_mlp(disc_key, (width, *config.disc.hidden, 1))
    return TrainState(
        agent=agent,
        averaged=agent.policy.params,
        disc=networks.init_network(disc, discriminator.make_optimizer(config.disc)),
        obs_normalizer=obs_normalizer,
        feature_normalizer=normalizer.moments(s),
        running=running,
        alpha=alpha,
        key=key,
        update=jnp.zeros((), jnp.int32),
        nan_count=jnp.zeros((), jnp.int32),
        episode_length=jnp.zeros(()),
        fall_rate=jnp.zeros(()),
    )


def _begun(
    key: Array,
    environment: Environment,
    alpha: Array | None,
    local_envs: int,
    samples: int,
    span: int,
) -> tuple[Running, Array, Array]:
    """Environments at a reset, and demonstrations of what leads on from there.

    One loop draws both, so that XLA compiles the reset once: the environments are those
    of its last round.

    Args:
        key: of this device; consumed.
        environment: of the task.
        alpha: [] level of compliance, or None: the environment's own.
        local_envs: B.
        samples: demonstrations; 0: those of one round.
        span: K.

    Returns:
        The environments, and obs [N, O] and action [N, A] of the demonstrations.
    """
    size = max(local_envs, min(samples, warm_start.SAMPLES))
    rounds = max(-(-samples // size), 1)
    keys = jax.random.split(key, (rounds, size))

    def reset(key: Array) -> Any:
        return environment.reset(key, alpha)

    def one(_: Any, keys: Array) -> tuple[Any, tuple[Array, Array]]:
        begun = jax.vmap(reset)(keys)
        return begun, (begun.obs, jax.vmap(environment.expert_action)(begun))

    # Of one reset: it is jitted, and traced already. Tracing it batched takes a while.
    shapes = jax.eval_shape(reset, jax.ShapeDtypeStruct((), keys.dtype))
    nothing = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), shapes)
    begun, shown = jax.lax.scan(one, nothing, keys)
    obs, action = (x.reshape(rounds * size, x.shape[-1]) for x in shown)
    count = samples or size
    running = Running.of(jax.tree.map(lambda x: x[:local_envs], begun), span)
    return running, obs[:count], action[:count]


def of_device(key: Array) -> Array:
    """The key of this device of the mesh axis."""
    return jax.random.fold_in(key, jax.lax.axis_index(AXIS))
