"""A program without physics: a character that stands still and costs nothing."""

from __future__ import annotations

import jax
import numpy as np

from dcc_jax.play import pull, stepping
from dcc_jax.play.program import Program
from dcc_jax.play.recording import Frame, Motion
from dcc_jax.play.runs import Run

NUMBERS = (
    "force_peak",
    "displacement",
    "root_displacement",
    "torque_rms",
    "r_q",
    "r_p",
    "r_task",
)


class Still(Program):
    """Steps into the same state again; `broken` says it is no number."""

    broken = False

    def compile(self, run: Run) -> None:
        self._compiled = (None, None)

    def reset(self, key, alpha):
        shapes = jax.eval_shape(self.environment.reset, stepping.episode_key(0, 0))
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)

    def step(self, run, state, key, told, count):
        scene = self.environment.scene
        force = np.zeros((pull.HANDS + 1, 3), np.float32)
        hands = state.task.hands
        force[-pull.HANDS :] = hands.force_w + hands.stiffness[:, None] * hands.target_w
        own = self.first_qpos[scene.qpos_adr : scene.qpos_adr + 55]
        motion = Motion(
            qpos=self.first_qpos,
            u=own,
            reference=own,
            force_w=force,
            point_w=np.zeros_like(force),
            mocap_pos=np.zeros((scene.model.nmocap, 3)),
            mocap_quat=np.tile([1.0, 0, 0, 0], (scene.model.nmocap, 1)),
        )
        numbers = dict.fromkeys(NUMBERS, np.float32(np.linalg.norm(force)))
        false, broken = np.bool_(False), np.bool_(self.broken)
        return state, Frame(numbers, motion, broken, false, broken)
