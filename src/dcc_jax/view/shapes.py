"""The shapes of a model's bodies as triangles.

Letters: V vertices, F faces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import trimesh

GEOM = mujoco.mjtGeom
VISIBLE_GROUPS = 2  # MuJoCo draws geoms up to this group


@dataclass(frozen=True)
class Shape:
    """What is seen of a body in one colour, in the body's frame."""

    body: int
    rgba: tuple[float, float, float, float]
    vertices: np.ndarray  # [V, 3] m
    faces: np.ndarray  # [F, 3]


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """The shapes of all bodies, the ground plane aside."""
    found: dict[tuple[int, tuple], list[Any]] = {}
    for geom in range(model.ngeom):
        mesh = None if _hidden(model, geom) else _mesh(model, geom)
        if mesh is not None:
            turn, place = np.empty(9), np.eye(4)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            place[:3, :3], place[:3, 3] = turn.reshape(3, 3), model.geom_pos[geom]
            mesh.apply_transform(place)
            colour = tuple(float(x) for x in model.geom_rgba[geom])
            found.setdefault((int(model.geom_bodyid[geom]), colour), []).append(mesh)
    return [_joined(body, rgba, meshes) for (body, rgba), meshes in found.items()]


def has_ground(model: mujoco.MjModel) -> bool:
    """Whether there is a ground plane."""
    return bool((model.geom_type == GEOM.mjGEOM_PLANE).any())


def tiles(count: int, parity: int) -> tuple[np.ndarray, np.ndarray]:
    """Every other tile of 1 m of a floor with `count` along an edge, around zero."""
    edge = np.arange(count) - count // 2
    corners = np.stack(np.meshgrid(edge, edge, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = corners[corners.sum(axis=1) % 2 == parity]
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    vertices = (corners[:, None] + square).reshape(-1, 2)
    first = 4 * np.arange(len(corners))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return np.pad(vertices.astype(float), ((0, 0), (0, 1))), faces


def grid(count: int) -> np.ndarray:
    """Ends [L, 2, 3] of lines 1 m apart, with `count` squares along an edge."""
    at, half = np.arange(count + 1.0) - count // 2, count / 2
    ends = np.stack(np.broadcast_arrays(at[:, None], [[-half, half]], 0.0), axis=-1)
    return np.concatenate([ends, ends[..., [1, 0, 2]]]).astype(np.float32)


def sphere(radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of a ball."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _hidden(model: mujoco.MjModel, geom: int) -> bool:
    return model.geom_group[geom] > VISIBLE_GROUPS or model.geom_rgba[geom, 3] == 0.0


def _mesh(model: mujoco.MjModel, geom: int) -> Any:
    """In the geom's frame; None of a plane and what else has no shape."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    make: Any = trimesh.creation
    if kind == GEOM.mjGEOM_SPHERE:
        return make.icosphere(subdivisions=2, radius=size[0])
    if kind == GEOM.mjGEOM_ELLIPSOID:
        return make.icosphere(subdivisions=2).apply_transform(np.diag([*size, 1.0]))
    if kind == GEOM.mjGEOM_CAPSULE:
        mesh = make.capsule(height=2.0 * size[1], radius=size[0], count=[16, 16])
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    if kind == GEOM.mjGEOM_CYLINDER:
        return make.cylinder(radius=size[0], height=2.0 * size[1], sections=24)
    if kind == GEOM.mjGEOM_BOX:
        return make.box(extents=2.0 * size)
    if kind == GEOM.mjGEOM_MESH:
        return _stored(model, int(model.geom_dataid[geom]))
    return None


def _stored(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return trimesh.Trimesh(
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
        model.mesh_face[face : face + model.mesh_facenum[mesh]],
        process=False,
    )


def _joined(body: int, rgba: tuple, meshes: list[Any]) -> Shape:
    mesh: Any = trimesh.util.concatenate(meshes)
    return Shape(body, rgba, np.asarray(mesh.vertices), np.asarray(mesh.faces))
