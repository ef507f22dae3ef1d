"""Fully connected networks as plain pytrees, and their optimiser step (Sec. 5.1).

Letters: N samples, I inputs, O outputs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

Array = jax.Array

Activation = Literal["relu", "leaky_relu", "elu", "silu", "tanh"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)


@flax.struct.dataclass
class Layer:
    """One affine map."""

    kernel: Array  # [I, O]
    bias: Array  # [O]


@flax.struct.dataclass
class Mlp:
    """Affine maps with a nonlinearity between them."""

    layers: tuple[Layer, ...]
    activation: Activation = flax.struct.field(pytree_node=False, default="relu")


@flax.struct.dataclass
class Network:
    """Parameters with the state of their optimiser."""

    params: Mlp
    opt_state: optax.OptState  # of all parameters as one vector


def init_mlp(
    key: Array,
    sizes: Sequence[int],
    output_gain: float = 1.0,
    activation: Activation = "relu",
) -> Mlp:
    """Draws the layers of a network, Xavier uniform (Sec. 5.1), biases zero.

    Args:
        key: consumed.
        sizes: inputs, hidden widths, outputs.
        output_gain: factor on the kernel of the last layer.
        activation: between the layers.
    """
    shapes = list(itertools.pairwise(sizes))
    # One draw for all layers: every random operation costs compile time.
    ends = np.cumsum([n_in * n_out for n_in, n_out in shapes])
    parts = jnp.split(jax.random.uniform(key, (int(ends[-1]),), minval=-1.0), ends[:-1])
    gains = [1.0] * (len(shapes) - 1) + [output_gain]
    layers = tuple(
        Layer(
            kernel=part.reshape(shape) * (gain * math.sqrt(6.0 / sum(shape))),
            bias=jnp.zeros(shape[1]),
        )
        for part, shape, gain in zip(parts, shapes, gains, strict=True)
    )
    return Mlp(layers=layers, activation=activation)


def apply_mlp(network: Mlp, x: Array) -> Array:
    """Output [..., O] of a network for x [..., I]."""
    activate: Callable[[Array], Array] = getattr(jax.nn, network.activation)
    *hidden, last = network.layers
    for layer in hidden:
        x = activate(x @ layer.kernel + layer.bias)
    return x @ last.kernel + last.bias


def clipped_adam(max_gradient_norm: float) -> optax.GradientTransformation:
    """Adam without its step size, which `descend` takes as data."""
    return optax.chain(
        optax.clip_by_global_norm(max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )


def init_network(params: Mlp, optimizer: optax.GradientTransformation) -> Network:
    """A network with a fresh optimiser state."""
    return Network(params=params, opt_state=optimizer.init(ravel_pytree(params)[0]))


def apply_gradients(
    network: Network,
    gradient: Mlp,
    learning_rate: Array | float,
    optimizer: optax.GradientTransformation,
    axis_name: str | None = None,
) -> tuple[Network, Array]:
    """One step along the gradient, or none at all when a number in it is not finite.

    All parameters are one vector here: one exchange between the devices and a few
    operations, instead of as many for every layer.

    Args:
        network: before the step.
        gradient: of the loss to be minimised, on this device.
        learning_rate: [] or a number.
        optimizer: of `clipped_adam`.
        axis_name: mesh axis over which the gradient is averaged.

    Returns:
        The network after the step, and whether the step was skipped, [] float.
    """
    slope, _ = ravel_pytree(gradient)
    if axis_name is not None:
        slope = jax.lax.pmean(slope, axis_name)
    params, restore = ravel_pytree(network.params)
    finite = jnp.all(jnp.isfinite(slope))
    step, opt_state = optimizer.update(slope, network.opt_state)
    stepped = (params - learning_rate * jnp.asarray(step), opt_state)
    params, opt_state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old),
        stepped,
        (params, network.opt_state),
    )
    return (
        Network(params=restore(params), opt_state=opt_state),
        1.0 - finite.astype(jnp.float32),
    )
