"""A policy that has seen the clips before its first update.

Departure: the paper's policies begin with random weights, and most of a short training
goes into finding out that running means moving the legs. Here the policy first learns
the feed-forward part by supervised regression: from a moment of the clips to the joint
targets that lead along them. It falls within a second or two, but in style; the rest is
left to PPO. `train.warm_start_steps = 0` leaves it out.

Letters: N samples, O observation, A actions.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optax

from dcc_jax.learn import networks, normalizer, ppo
from dcc_jax.learn.exchange import mean_tree
from dcc_jax.learn.normalizer import Normalizer
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.rollout import Environment

Array = jax.Array

SAMPLES = 256  # of a step, over all devices; 1024 lead to the same error
LEARNING_RATE = 1e-3


def warm_start(
    key: Array,
    agent: ppo.Agent,
    obs_normalizer: Normalizer,
    environment: Environment,
    config: PpoConfig,
    steps: int,
    axis_name: str,
) -> ppo.Agent:
    """Regression of the policy's mean action on demonstrations.

    Args:
        key: of this device; consumed.
        agent: with fresh networks.
        obs_normalizer: with which the policy will begin.
        environment: shows what to do.
        config: of the policy; its optimiser's memory is fresh again afterwards.
        steps: gradient steps; the step size falls to zero over them.
        axis_name: mesh axis whose devices share the samples.
    """
    local = max(SAMPLES // jax.lax.axis_size(axis_name), 1)
    falling = optax.linear_schedule(LEARNING_RATE, 0.0, steps)
    optimizer = networks.clipped_adam(falling, config.max_gradient_norm)

    def loss(params: networks.Mlp, obs: Array, action: Array) -> Array:
        error = networks.apply_mlp(params, obs) - action
        return jnp.mean(jnp.sum(jnp.square(error), axis=-1))

    def step(policy: networks.Network, key: Array):
        keys = jax.random.split(key, local)
        obs, action = jax.vmap(environment.expert_action)(keys)
        obs = normalizer.normalize(obs_normalizer, obs)
        gradient = mean_tree(jax.grad(loss)(policy.params, obs, action), axis_name)
        return networks.apply_gradients(policy, gradient, optimizer)

    begin = networks.init_network(agent.policy.params, optimizer)
    policy, _ = jax.lax.scan(step, begin, jax.random.split(key, steps))
    fresh = dataclasses.replace(agent.policy, params=policy.params)
    return dataclasses.replace(agent, policy=fresh)
