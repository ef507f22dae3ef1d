"""Inverse dynamics of a clip: what its joints and its soles would have to do."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import nnls

from dcc_jax.character import compose_scene, load_character
from dcc_jax.motion.clip import Clip

TOUCH = 0.012  # m, a sole sphere lower than this may carry
ROOT_SCALE = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])  # N m count thrice against N


@dataclass(frozen=True)
class Effort:
    """What a clip asks for, in every frame but the first and the last."""

    force: np.ndarray  # [T] share of the weight that no force under the soles explains
    moment: np.ndarray  # [T] N m about the root, likewise
    torque: np.ndarray  # [T] largest joint torque over its limit
    speed: float  # rad/s, of the fastest joint


def effort(clip: Clip) -> Effort:
    """MuJoCo's inverse dynamics, less the best forces in the soles' friction cones."""
    character = load_character()
    model = compose_scene(character, floor=False)
    data = mujoco.MjData(model)
    qpos, dt = clip.qpos.astype(float), 1.0 / clip.fps
    qvel = np.zeros((len(qpos) - 1, model.nv))
    for step, begin, end in zip(qvel, qpos[:-1], qpos[1:], strict=True):
        mujoco.mj_differentiatePos(model, step, dt, begin, end)
    left = np.zeros((len(qpos) - 2, model.nv))
    for k, frame in enumerate(qpos[1:-1]):
        data.qpos[:] = frame
        data.qvel[:] = 0.5 * (qvel[k] + qvel[k + 1])
        data.qacc[:] = (qvel[k + 1] - qvel[k]) / dt
        mujoco.mj_inverse(model, data)
        left[k] = _less_contacts(data.qfrc_inverse, _cone_edges(model, data))
    weight = model.body_mass.sum() * -model.opt.gravity[2]
    return Effort(
        force=np.linalg.norm(left[:, :3], axis=1) / weight,
        moment=np.linalg.norm(left[:, 3:6], axis=1),
        torque=(np.abs(left) / character.torque_limit)[:, 6:].max(1),
        speed=np.linalg.norm(qvel[:, 6:].reshape(-1, 12, 3), axis=-1).max(),
    )


def _cone_edges(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Generalized forces [N, 42] of unit friction pyramids under the low soles."""
    edges = []
    for geom in range(model.ngeom):
        point = data.geom_xpos[geom] - [0.0, 0.0, model.geom_size[geom, 0]]
        if "_sole_" not in model.geom(geom).name or point[2] > TOUCH:
            continue
        J = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, J, None, point, model.geom_bodyid[geom])
        edges += [J.T @ [x, y, 1.0] for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return np.array(edges).reshape(-1, model.nv)


def _less_contacts(force: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The force [42] without the pushes along `edges` that leave least on the root."""
    if not len(edges):
        return force.copy()
    small = 1e-3 * np.eye(len(edges))  # one of many equal splits between the feet
    system = np.concatenate([ROOT_SCALE[:, None] * edges.T[:6], small])
    goal = np.concatenate([ROOT_SCALE * force[:6], np.zeros(len(edges))])
    return force - edges.T @ nnls(system, goal)[0]
