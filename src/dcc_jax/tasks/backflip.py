"""A backflip on the trampoline (Sec. 5.3), following its clip in time.

The clip was made for a hard floor, on which the legs alone throw the character up; the
plate gives way under them. Its kick is timed with the push-off and gives back what that
costs: with joints that simply follow the clip, 1500 N lead to the clip's flight of 0.7
s. The trampoline with the clips `stand jump_high backflip` is the same without a clock.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from dcc_jax import physics
from dcc_jax.motion.reference import RefState
from dcc_jax.tasks.trampoline import Trampoline, TrampolineState

Array = jax.Array


@dataclass(frozen=True)
class Backflip(Trampoline):
    """Crouch, turn over backwards, land on the feet, stand."""

    name: ClassVar[str] = "backflip"
    clips: ClassVar[tuple[str, ...]] = ("backflip",)
    follows_reference: ClassVar[bool] = True
    start_radius: ClassVar[float] = 0.05
    config_overrides: ClassVar[Mapping[str, Any]] = {}

    interval: float = 100.0
    """Time between two kicks, s: longer than an episode, so the plate kicks once."""
    kick: float = 1500.0
    """Upward force of the kick on the plate, N."""
    kick_at: float = 1.2
    """Moment of the clip at which the kick begins, s: the legs begin to push."""
    kick_spread: float = 0.03
    """How much earlier or later the kick may come, s; the policy observes when."""

    def quiet(self) -> Backflip:
        """The kick is part of the flip."""
        return self

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[TrampolineState, Array, Array]:
        """The plate at rest; it kicks if the clip's push-off is still to come."""
        plate_key, kick_key = jax.random.split(key)
        state, qpos, qvel = super().reset(plate_key, scene, reference)
        early = self.kick_spread * jax.random.uniform(kick_key, minval=-1.0)
        to_come = self.kick_at - reference.time - early
        missed = to_come < -self.kick_time
        left = jnp.where(missed, self.interval, to_come)
        return dataclasses.replace(state, next_bounce=left), qpos, qvel
