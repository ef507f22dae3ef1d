"""A character that hangs on nothing and holds still: its pelvis hardly moves at all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from dcc_jax.env.task import Forces, Task

HEAVY = 1e7  # kg and kg m^2, added to the pelvis; without weight of its own


@dataclass(frozen=True)
class Held(Task):
    """No floor, no weight, a base that stays where it is."""

    name: ClassVar[str] = "held"
    clips: ClassVar[tuple[str, ...]] = ("stand",)

    @property
    def has_floor(self) -> bool:
        return False

    def extend(self, spec: mujoco.MjSpec) -> None:
        spec.option.gravity = [0.0, 0.0, 0.0]
        spec.joint("root").armature = HEAVY

    def forces(self, scene, state, kin, solution, action):
        nothing = jnp.zeros((1, 3))
        return state, Forces(
            nothing, nothing, jnp.zeros(1, jnp.int32), jnp.ones((), bool)
        )
