"""The policy that a training begins with, where it is another training's."""

from __future__ import annotations

from dcc_jax.config import Config
from dcc_jax.learn.networks import Mlp
from dcc_jax.learn.rollout import Environment, Policy
from dcc_jax.training import checkpoint, folder


def starting_policy(config: Config, environment: Environment) -> Policy | None:
    """The policy of `train.start_from`; None where nothing is named.

    Raises:
        ValueError: there is none, or its layers are not those of this training.
    """
    name = config.train.start_from
    if name is None:
        return None
    policy = checkpoint.load_policy(folder.find(name))
    ends = environment.observation_size, environment.action_size
    wanted = _told((ends[0], *config.ppo.hidden, ends[1]), config.ppo.activation)
    has = _told(_sizes(policy.params), policy.params.activation)
    if has != wanted:
        raise ValueError(f"train.start_from {name} has {has}; this training {wanted}")
    return policy


def _sizes(params: Mlp) -> tuple[int, ...]:
    kernels = [layer.kernel for layer in params.layers]
    return (*(kernel.shape[0] for kernel in kernels), kernels[-1].shape[1])


def _told(sizes: tuple[int, ...], activation: str) -> str:
    observations, *hidden, actions = sizes
    layers = ", ".join(map(str, hidden))
    return (
        f"{observations} observations, {actions} actions and layers of {layers} "
        f"({activation})"
    )
