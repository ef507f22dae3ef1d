"""What somebody holds: the point, the rope, and how stiff the body is there."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import mujoco
import numpy as np
import viser

from dcc_jax.character import compose_scene
from dcc_jax.control.stiffness import ellipsoid, modulated_stiffness, stiffness
from dcc_jax.env.environment import Environment
from dcc_jax.play.pull import HANDS, PULL
from dcc_jax.play.recording import Motion
from dcc_jax.view import shapes

BLUE, GREEN = (90, 190, 240), (60, 170, 90)
SHELL_FORCE = 50.0  # N; the ellipsoids are where it takes the point
SHELL_LIMIT = 0.5  # m, of an ellipsoid's axis


@dataclass(frozen=True)
class Grab:
    """A point of a body that somebody holds."""

    body: str
    point: np.ndarray  # [3] m, in the body's frame
    target: np.ndarray  # [3] m, of the page: it stays under the mouse


def moved(grab: Grab, target: np.ndarray) -> Grab:
    """The same point, pulled elsewhere."""
    return dataclasses.replace(grab, target=np.asarray(target, float))


def place_w(data: mujoco.MjData, grab: Grab) -> np.ndarray:
    """Where a held point is, [3] m, world."""
    body = data.body(grab.body)
    return body.xpos + body.xmat.reshape(3, 3) @ grab.point


class Grip:
    """The rope, its force, and the ellipsoids of K and K_hat (Fig. 2)."""

    def __init__(
        self, scene: viser.SceneApi, root: str, environment: Environment
    ) -> None:
        self._environment = environment
        self._alone = compose_scene(environment.scene.character, floor=False)
        nowhere = np.zeros((1, 2, 3), np.float32)
        self._rope = scene.add_line_segments(
            f"{root}/rope", nowhere, GREEN, thickness=0.012, visible=False
        )
        self._label = scene.add_label(f"{root}/pull", "", visible=False)
        self._shells = [
            scene.add_mesh_simple(
                f"{root}/{name}",
                *shapes.sphere(),
                color=colour,
                opacity=0.35,
                cast_shadow=False,
                visible=False,
            )
            for name, colour in (("K", GREEN), ("K_hat", BLUE))
        ]

    def show(
        self,
        data: mujoco.MjData,
        grab: Grab | None,
        offset: np.ndarray,
        motion: Motion,
        alpha: float | None,
    ) -> None:
        """Shows what is held, or nothing.

        Args:
            data: where the bodies are.
            grab: what is held.
            offset: of the page [3], m.
            motion: of the control step, with the force.
            alpha: level of compliance that acts; None: no ellipsoids.
        """
        K = None if grab is None or alpha is None else self.stiffness(data, grab)
        for handle in (self._rope, self._label):
            handle.visible = grab is not None
        for handle in self._shells:
            handle.visible = K is not None
        if grab is None:
            return
        place, end = place_w(data, grab), grab.target + offset
        self._rope.points = np.array([[place, end]], np.float32)
        self._label.position = end
        force = np.linalg.norm(np.asarray(motion.force_w)[PULL - HANDS])
        if force > 0.0:
            self._label.text = f"{force:.0f} N"
        if K is not None and alpha is not None:
            self._show_shells(place, K, modulated_stiffness(K, min(alpha, 0.99)))

    def _show_shells(self, place: np.ndarray, *matrices: np.ndarray) -> None:
        for handle, matrix in zip(self._shells, matrices, strict=True):
            axes, along = ellipsoid(matrix)
            turn = np.empty(4)
            mujoco.mju_mat2Quat(turn, axes.flatten())
            handle.position, handle.wxyz = place, turn
            x, y, z = np.clip(SHELL_FORCE / along, 0.004, SHELL_LIMIT).tolist()
            handle.scale = x, y, z

    def stiffness(self, data: mujoco.MjData, grab: Grab) -> np.ndarray | None:
        """K [3, 3] N/m of the grabbed point, Eq. (4); None where no joint moves it."""
        scene = self._environment.scene
        character = scene.character
        if grab.body not in character.body_names[1:]:
            return None
        qpos = data.qpos[scene.qpos_adr : scene.qpos_adr + character.nq]
        return stiffness(self._alone, qpos, grab.body, grab.point, character.kp)
