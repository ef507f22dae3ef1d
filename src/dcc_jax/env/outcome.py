"""How a control step is judged: the tracking reward, falling, the end of the time.

Everything is written for ONE environment; `q` are the character's coordinates [55].
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.character import BODIES
from dcc_jax.env import features, rewards
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.features import Kinematics
from dcc_jax.env.rewards import RewardConfig
from dcc_jax.motion.reference import References, RefState

Array = jax.Array

CROUCH_MARGIN = 0.1  # m, by which the pelvis may be lower than in the clips
LIMBS = np.array([not name.endswith(("foot", "shin")) for name in BODIES])
"""Bodies that have no business on the ground."""


@dataclass(frozen=True)
class FallTest:
    """When a character counts as fallen."""

    pelvis: float  # m above the ground, below which it has
    clearance: float  # m, likewise, of the origin of any body but shins and feet

    @classmethod
    def of(cls, config: EnvConfig, references: References) -> FallTest:
        """As configured, but no stricter than the clips themselves are."""
        lowest = float(references.qpos[..., 2].min())
        return cls(
            min(config.fall_height, lowest - CROUCH_MARGIN), config.limb_clearance
        )

    def __call__(self, kinematics: Kinematics, q: Array, ground: Array) -> Array:
        """Whether it has fallen, [] bool, on ground of that height [], m."""
        pos_w, _ = features.body_poses(kinematics, q)
        touches = pos_w[LIMBS, 2] < ground + self.clearance
        return (q[2] < ground + self.pelvis) | jnp.any(touches)


def tracking(
    kinematics: Kinematics,
    q: Array,
    yielded: Array,
    reference: Array,
    config: RewardConfig,
) -> Array:
    """How well q (-) yielded follows the reference [55] in time (Appendix), []."""
    coords = kinematics.coords
    _, here = coords.split_q(quat.ominus(coords, q, yielded))
    _, there = coords.split_q(reference)
    error = quat.log(quat.mul(quat.inv(there), here))
    return rewards.tracking_reward(error, config)


def clip_ended(references: References, at: RefState) -> Array:
    """Whether a clip that is followed in time is at its end, [] bool."""
    ended = at.time >= references.duration[at.clip] - 1e-4
    return ended & ~references.loop[at.clip]
