"""How a control step is judged: the tracking reward, falling, the end of the time.

Everything is written for ONE environment; `q` are the character's coordinates [55].
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import quat
from dcc_jax.character import BODIES, compose_scene, load_character
from dcc_jax.env import features, rewards
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.features import Kinematics
from dcc_jax.env.rewards import RewardConfig
from dcc_jax.motion.reference import References, RefState

Array = jax.Array

CROUCH_MARGIN = 0.1  # m, by which the pelvis may be lower than in the clips
LIMB_MARGIN = 0.05  # m, likewise a limb
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
        poses = np.asarray(references.qpos).reshape(-1, references.qpos.shape[-1])
        return cls(
            min(config.fall_height, float(poses[:, 2].min()) - CROUCH_MARGIN),
            min(config.limb_clearance, _lowest_limb(poses) - LIMB_MARGIN),
        )

    def __call__(self, kinematics: Kinematics, q: Array, ground: Array) -> Array:
        """Whether it has fallen, [] bool, on ground of that height [], m."""
        pos_w, _ = features.body_poses(kinematics, q)
        touches = pos_w[LIMBS, 2] < ground + self.clearance
        return (q[2] < ground + self.pelvis) | jnp.any(touches)


def _lowest_limb(poses: np.ndarray) -> float:
    """The least height of `LIMBS` in poses [N, 55], m, by every fourth of them."""
    model = compose_scene(load_character(), floor=False)
    data, lowest = mujoco.MjData(model), np.inf
    for pose in poses[::4]:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        lowest = min(lowest, float(data.xpos[1:][LIMBS, 2].min()))
    return lowest


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
