"""A character that hangs in the air and holds still: its pelvis hardly moves at all."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax.config import make_config
from dcc_jax.env import observation
from dcc_jax.env.task import Forces, Task
from dcc_jax.play.runs import Run, find_run

HEAVY = 1e7  # kg and kg m^2, added to the pelvis; it adds no weight


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

    def reset(self, key, scene, reference):
        state, qpos, qvel = super().reset(key, scene, reference)
        return state, qpos, jnp.zeros_like(qvel)

    def forces(self, scene, state, kin, solution, action):
        none = jnp.zeros((1, 3))
        return state, Forces(
            force_w=none,
            point_w=none,
            body=jnp.zeros(1, jnp.int32),
            gate=jnp.ones((), bool),
        )


def held_run() -> Run:
    """A policy that asks for the nominal pose whatever it observes."""
    config = make_config(Held, "smoke").with_(
        {
            "env.compliance.law": "admittance",
            "env.alpha": 0.0,
            "env.alpha_max": 0.9,
        }
    )
    policy = find_run("push").policy
    size = observation.size(Held(), has_phase=False, has_pose=False)

    def shortened(leaf: jax.Array) -> np.ndarray:
        own = policy.normalizer.mean.shape[0]
        return np.asarray(leaf[:size] if leaf.shape[:1] == (own,) else leaf)

    policy = jax.tree.map(shortened, policy)
    zeros = jax.tree.map(np.zeros_like, policy.params)
    return Run("held", config, dataclasses.replace(policy, params=zeros))
