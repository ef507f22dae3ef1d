"""What is seen: the bodies, the ghost, the forces, and what somebody holds.

Everything hangs on one node. It moves against the character's root where the camera
follows: so the mouse keeps turning the camera, and a browser its own one.
Letters: F forces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import viser

from dcc_jax.env.environment import Environment
from dcc_jax.play.recording import Motion
from dcc_jax.play.simulation import Moment
from dcc_jax.view import shapes
from dcc_jax.view.floor import Floor
from dcc_jax.view.grip import BLUE, Grab, Grip, place_w

ROOT = "/world"
ORANGE = (242, 89, 15)
GHOST_OPACITY = 0.3
NEWTONS_A_METRE = 250.0  # of an arrow
LONGEST_ARROW = 1.2  # m
ECHO = 6  # control steps in which an arrow fades: a ball touches for one or two
FOLLOW = 0.15  # share of the way to the root that the camera goes in a control step
APART = 0.005  # m, below which the ghost is not shown

DragHandler = Callable[[str, Any], None]


@dataclass
class Looks:
    """What is to be seen."""

    follow: bool = True
    ghost: bool = True
    arrows: bool = True
    shells: bool = True
    plain: bool = False
    """Lines in place of a floor, no shadows: fast where there is no graphics card."""


class Stage:
    """The nodes of one environment's scene on a page."""

    def __init__(
        self,
        server: viser.ViserServer,
        environment: Environment,
        on_drag: DragHandler,
    ) -> None:
        """Builds the scene in place of any other.

        Args:
            server: of the page.
            environment: whose model is shown.
            on_drag: told the name of a body and viser's event.
        """
        self._scene, self._server = server.scene, server
        self._environment = environment
        self._model = environment.scene.model
        self._data = mujoco.MjData(self._model)
        self._shadow = mujoco.MjData(self._model)
        self._on_drag = on_drag
        self.offset = np.zeros(3)
        """m [3]: a point of the world is on the page at its place less the offset."""
        with server.atomic():
            server.scene.remove_by_name(ROOT)
            self._build()

    def _build(self) -> None:
        add = self._scene
        self._root = add.add_frame(ROOT, show_axes=False)
        ground = shapes.has_ground(self._model)
        self._floor = Floor(self._scene, ROOT) if ground else None
        found = shapes.shapes(self._model)
        self._bodies = [(s.body, self._shape(i, s)) for i, s in enumerate(found)]
        own = self._model.body_rootid == self._model.dof_bodyid[self._dof_adr]
        self._ghosts = [
            (s.body, self._ghost(i, s)) for i, s in enumerate(found) if own[s.body]
        ]
        nowhere = np.zeros((1, 2, 3), np.float32)
        self._arrows = add.add_arrows(f"{ROOT}/forces", nowhere, ORANGE, visible=False)
        self._grip = Grip(self._scene, ROOT, self._environment)

    @property
    def _dof_adr(self) -> int:
        return self._environment.scene.dof_adr

    def _shape(self, index: int, shape: shapes.Shape) -> viser.MeshHandle:
        handle = self._scene.add_mesh_simple(
            f"{ROOT}/body/{index}",
            shape.vertices,
            shape.faces,
            color=_rgb(shape.rgba),
            opacity=None if shape.rgba[3] == 1.0 else shape.rgba[3],
        )
        name = self._model.body(shape.body).name
        if self._moves(shape.body):

            @handle.on_drag
            async def _(event: Any) -> None:
                self._on_drag(name, event)

        return handle

    def _moves(self, body: int) -> bool:
        """Whether a force can move a body: it hangs on joints."""
        return (
            bool(self._model.body_weldid[body])
            and self._model.body_mocapid[self._model.body_rootid[body]] < 0
        )

    def _ghost(self, index: int, shape: shapes.Shape) -> viser.MeshHandle:
        return self._scene.add_mesh_simple(
            f"{ROOT}/ghost/{index}",
            shape.vertices,
            shape.faces,
            color=BLUE,
            opacity=GHOST_OPACITY,
            cast_shadow=False,
            visible=False,
        )

    def show(
        self,
        moments: Sequence[Moment],
        ghost_qpos: np.ndarray | None,
        looks: Looks,
        grab: Grab | None,
        alpha: float,
    ) -> None:
        """Shows the last of some moments.

        Args:
            moments: the last `ECHO` of the episode, or fewer; arrows fade over them.
            ghost_qpos: coordinates of the ghost [nq]; None: none.
            looks: what is to be seen.
            grab: what somebody holds.
            alpha: level of compliance that acts.
        """
        motion = moments[-1].motion
        _place(self._model, self._data, np.asarray(motion.qpos), motion)
        with self._server.atomic():
            self._follow(looks.follow)
            for body, handle in self._bodies:
                handle.position = self._data.xpos[body]
                handle.wxyz = self._data.xquat[body]
            self._show_ghost(ghost_qpos if looks.ghost else None, motion)
            self._show_arrows(moments if looks.arrows else [])
            self._grip.show(
                self._data, grab, self.offset, motion, alpha if looks.shells else None
            )

    def set_plain(self, plain: bool) -> None:
        """With or without floor, shadows and reflections."""
        with self._server.atomic():
            if self._floor is not None:
                self._floor.set_plain(plain)
            self._scene.configure_default_lights(cast_shadow=not plain)
            self._scene.configure_environment_map(None if plain else "city")

    def still(self, qpos: np.ndarray) -> None:
        """Shows a pose [nq] and nothing else, while there is no motion yet."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        with self._server.atomic():
            for body, handle in self._bodies:
                handle.position = self._data.xpos[body]
                handle.wxyz = self._data.xquat[body]

    def local_point(self, body: str, place: np.ndarray) -> np.ndarray:
        """A point of the page [3] as one of a body, in its frame, m.

        It is what the browser saw a moment ago. Of a body that moves on it is kept
        within the body's reach.
        """
        index = self._model.body(body).id
        turn = self._data.xmat[index].reshape(3, 3)
        point = turn.T @ (place + self.offset - self._data.xpos[index])
        geoms = np.flatnonzero(self._model.geom_bodyid == index)
        reach = self._model.geom_rbound[geoms][:, None]
        low = (self._model.geom_pos[geoms] - reach).min(axis=0)
        high = (self._model.geom_pos[geoms] + reach).max(axis=0)
        return np.clip(point, low, high)

    def place_w(self, grab: Grab) -> np.ndarray:
        """Where a held point is, [3] m, world."""
        return place_w(self._data, grab)

    def _follow(self, follow: bool) -> None:
        adr = self._environment.scene.qpos_adr
        root = np.array([*self._data.qpos[adr : adr + 2], 0.0])
        if follow:
            away = root - self.offset
            # Who was reset is elsewhere at once.
            share = FOLLOW if np.linalg.norm(away) < 1.0 else 1.0
            self.offset = self.offset + share * away
        self._root.position = -self.offset
        if self._floor is not None:
            self._floor.follow(root)

    def _show_ghost(self, qpos: np.ndarray | None, motion: Motion) -> None:
        if qpos is not None:
            _place(self._model, self._shadow, qpos, motion)
        for body, handle in self._ghosts:
            apart = qpos is not None and _apart(self._data, self._shadow, body)
            _set_visible(handle, apart)
            if apart:
                handle.position = self._shadow.xpos[body]
                handle.wxyz = self._shadow.xquat[body]

    def _show_arrows(self, moments: Sequence[Moment]) -> None:
        lines = arrows(moments)
        _set_visible(self._arrows, len(lines) > 0)
        if len(lines):
            self._arrows.points = lines


def arrows(moments: Sequence[Moment]) -> np.ndarray:
    """Ends [F, 2, 3], m, of the arrows of the forces; they fade over the moments."""
    lines = []
    recent = [m for m in moments if m.episode == moments[-1].episode][-ECHO:]
    count = len(recent)
    for force in range(0 if not recent else len(recent[-1].motion.force_w)):
        best, longest = None, 1e-3
        for age, moment in enumerate(reversed(recent)):
            vector = np.asarray(moment.motion.force_w)[force] / NEWTONS_A_METRE
            size = np.linalg.norm(vector)
            shown = min(size, LONGEST_ARROW) * (1.0 - age / max(count, ECHO))
            if shown > longest:
                start = np.asarray(moment.motion.point_w)[force]
                best, longest = (start, start + shown / size * vector), shown
        if best is not None:
            lines.append(best)
    return np.array(lines, np.float32).reshape(-1, 2, 3)


def _place(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, motion: Motion
) -> None:
    data.qpos[:] = qpos
    data.mocap_pos[:], data.mocap_quat[:] = motion.mocap_pos, motion.mocap_quat
    mujoco.mj_kinematics(model, data)


def _apart(data: mujoco.MjData, other: mujoco.MjData, body: int) -> bool:
    gap = np.linalg.norm(data.xpos[body] - other.xpos[body])
    turn = np.linalg.norm(data.xmat[body] - other.xmat[body])
    return bool(gap + 0.1 * turn > APART)


def _set_visible(handle: Any, visible: bool) -> None:
    if handle.visible != visible:
        handle.visible = bool(visible)


def _rgb(rgba: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * x) for x in rgba[:3])
    return red, green, blue
