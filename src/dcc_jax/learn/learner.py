"""The update compiled for all devices: one program, environments sharded.

Letters: R runs of a sweep, D devices.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dcc_jax.learn.rollout import Environment, Policy
from dcc_jax.learn.state import (
    AXIS,
    LearnerConfig,
    TrainConfig,
    TrainState,
    UpdateReport,
    init_state,
)
from dcc_jax.learn.update import chunk_size, update_state

Array = jax.Array
Init = Callable[[Array, Array | None], TrainState]
Update = Callable[[TrainState], tuple[TrainState, UpdateReport]]


def make_mesh(config: TrainConfig, devices: int | None = None) -> Mesh:
    """All devices of this process, or the first few, in one axis named `env`.

    Raises:
        ValueError: the devices cannot share the environments equally.
    """
    count = len(jax.devices()) if devices is None else devices
    _check_multiple("train.num_envs", config.num_envs, count)
    return jax.make_mesh((count,), (AXIS,), devices=jax.devices()[:count])


def check_sizes(config: LearnerConfig, devices: int) -> None:
    """Raises ValueError where minibatches or chunks do not come out even."""
    local_envs = config.train.num_envs // devices
    _check_multiple("ppo.minibatch_size", config.ppo.minibatch_size, devices)
    _check_multiple("disc.minibatch_size", config.disc.minibatch_size, devices)
    tuples, size = config.train.tuples_per_update, config.ppo.minibatch_size
    if tuples % size:
        fits = size // math.gcd(size, config.train.unroll_length)
        fits = math.lcm(fits, devices)
        raise ValueError(
            f"ppo.minibatch_size must divide the {tuples} tuples of an update "
            f"(train.num_envs x train.unroll_length), as with a train.num_envs that is "
            f"a multiple of {fits}; got {size}"
        )
    chunk = chunk_size(config.train, local_envs)
    if chunk is not None and local_envs % chunk:
        raise ValueError(
            f"train.chunk_size must divide the {local_envs} environments of a device, "
            f"got {chunk}"
        )


def make_init(
    environment: Environment,
    config: LearnerConfig,
    mesh: Mesh,
    runs: bool = False,
    start: Policy | None = None,
) -> Init:
    """The function (key, alpha) -> TrainState, compiled for the mesh.

    Args:
        environment: of the task.
        config: sizes and rates.
        mesh: of `make_mesh`.
        runs: keys and alphas carry a leading axis [R], and so does the state.
        start: the policy they begin with; None: as the configuration says.
    """
    check_sizes(config, mesh.size)
    local_envs = config.train.num_envs // mesh.size

    def init(key: Array, alpha: Array | None) -> TrainState:
        return init_state(key, alpha, environment, config, local_envs, start)

    body = jax.vmap(init) if runs else init
    sharded = jax.shard_map(
        body,
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=_state_specs(runs),
        check_vma=False,
    )
    return jax.jit(sharded)


def make_update(
    environment: Environment, config: LearnerConfig, mesh: Mesh, runs: bool = False
) -> Update:
    """The function TrainState -> (TrainState, UpdateReport), compiled for the mesh.

    Its argument is donated: it is gone after the call.
    """

    def update(state: TrainState) -> tuple[TrainState, UpdateReport]:
        return update_state(state, environment, config)

    body = jax.vmap(update) if runs else update
    specs = _state_specs(runs)
    shared, split = PartitionSpec(), specs.running
    sharded = jax.shard_map(
        body,
        mesh=mesh,
        in_specs=(specs,),
        out_specs=(specs, UpdateReport(metrics=shared, incident=split)),  # pyright: ignore
        check_vma=False,
    )
    return jax.jit(sharded, donate_argnums=0)


def state_shardings(mesh: Mesh, state: TrainState, runs: bool = False) -> TrainState:
    """The sharding of every leaf, for putting a restored state on the devices."""
    specs = _state_specs(runs)
    return jax.tree.map(
        lambda spec, part: jax.tree.map(lambda _: NamedSharding(mesh, spec), part),
        specs,
        state,
        is_leaf=lambda x: isinstance(x, PartitionSpec),
    )


def _state_specs(runs: bool) -> TrainState:
    shared = PartitionSpec()
    split = PartitionSpec(None, AXIS) if runs else PartitionSpec(AXIS)
    names = TrainState.__dataclass_fields__
    # Any: a tree of specs has the state's structure, not its types.
    specs: dict[str, Any] = {n: split if n == "running" else shared for n in names}
    return TrainState(**specs)


def _check_multiple(name: str, value: int, devices: int) -> None:
    if value % devices:
        larger = value + devices - value % devices
        raise ValueError(
            f"{name} must be a multiple of the {devices} devices, as {larger} is, "
            f"got {value}"
        )
