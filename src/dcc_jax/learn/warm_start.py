"""A policy that has seen the clips before its first update.

Departure: the paper's policies begin with random weights, and most of a short training
goes into finding out that running means moving the legs. Here the policy first learns
the feed-forward part by supervised regression: from a moment of the clips to the joint
targets that lead along them. It falls within a second or two, but in style; the rest is
left to PPO. `train.warm_start_steps = 0` leaves it out.

Letters: S steps, N samples of a step, O observation, A actions.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optax

from dcc_jax.learn import networks, ppo
from dcc_jax.learn.exchange import mean_tree
from dcc_jax.learn.ppo import PpoConfig

Array = jax.Array

SAMPLES = 128  # of a step, over all devices; more lead to the same error
LEARNING_RATE = 1e-3


def warm_start(
    agent: ppo.Agent, obs: Array, action: Array, config: PpoConfig, axis_name: str
) -> ppo.Agent:
    """Regression of the policy's mean action on demonstrations.

    Args:
        agent: with fresh networks.
        obs: [S, N, O] normalised, of this device, of S gradient steps; the step size
            falls to zero over them.
        action: [S, N, A] rad.
        config: of the policy; its optimiser's memory is fresh again afterwards.
        axis_name: mesh axis whose devices share the samples.
    """
    steps = obs.shape[0]
    falling = optax.linear_schedule(LEARNING_RATE, 0.0, steps)
    optimizer = networks.clipped_adam(falling, config.max_gradient_norm)

    def loss(params: networks.Mlp, obs: Array, action: Array) -> Array:
        error = networks.apply_mlp(params, obs) - action
        return jnp.mean(jnp.sum(jnp.square(error), axis=-1))

    def step(policy: networks.Network, shown: tuple[Array, Array]):
        gradient = mean_tree(jax.grad(loss)(policy.params, *shown), axis_name)
        return networks.apply_gradients(policy, gradient, optimizer)

    begin = networks.init_network(agent.policy.params, optimizer)
    policy, _ = jax.lax.scan(step, begin, (obs, action))
    fresh = dataclasses.replace(agent.policy, params=policy.params)
    return dataclasses.replace(agent, policy=fresh)
