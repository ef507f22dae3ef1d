"""What one environment carries from control step to control step, and within one."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax import physics
from dcc_jax.control.compliance import Displacement
from dcc_jax.control.ranges import Room
from dcc_jax.env.metrics import Metrics, Sums
from dcc_jax.env.task import RootTarget
from dcc_jax.motion.reference import RefState

Array = jax.Array


@flax.struct.dataclass
class EnvState:
    """Everything that ONE environment carries, and what the learner reads of it."""

    obs: Array  # [O]
    features: Array  # [272] s' of the discriminator
    previous_features: Array  # [272] s
    condition: Array  # [C] the discriminator's, beside the features
    r_q: Array  # [] where the clip is followed in time, else 0
    r_p: Array  # []
    r_task: Array  # []
    terminated: Array  # [] bool
    truncated: Array  # [] bool
    nan: Array  # [] bool
    metrics: Metrics
    body: physics.State
    displacement: Displacement  # of the character
    u_previous: Array  # [55] one control step ago
    ground_previous: Array  # [] m, height of what it stood on then
    yield_previous: Array  # [55] `Environment.yielded` then
    q_previous: Array  # [55] the character's coordinates then
    start: RootTarget  # of the reference, at the reset
    reference: RefState  # now, where the clip is followed in time; else at the reset
    alpha: Array  # []
    time: Array  # [] s since the reset
    task: Any


@flax.struct.dataclass
class ControlInputs:
    """What stays the same in the physics steps of one control step."""

    action: Array  # [A]
    pose: Array  # [55] that the policy asks for
    alpha: Array  # []
    room: Room | None  # of u, that the reference's pose leaves of the joint ranges
    reference_before: RefState  # at the beginning of the control step
    reference: RefState  # at its end
    time: Array  # [] s since the reset, at its beginning


@flax.struct.dataclass
class Substep:
    """Carried through the physics steps of one control step."""

    body: physics.State
    displacement: Displacement
    task: Any
    time: Array
    sums: Sums


def terminate_on_nonfinite(new: EnvState, old: EnvState) -> EnvState:
    """`new`, or where a number of it is not finite, `old` as a terminated state."""
    leaves = [x for x in jax.tree.leaves(new) if jnp.issubdtype(x.dtype, jnp.inexact)]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]))
    kept = jax.tree.map(lambda n, o: jnp.where(finite, n, o), new, old)
    return dataclasses.replace(
        kept,
        terminated=kept.terminated | ~finite,
        truncated=kept.truncated & finite,
        nan=~finite,
    )
