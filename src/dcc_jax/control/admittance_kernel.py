"""The law `admittance` by the kernel for CPUs: what it is given, and the call.

`compliance.admittance` in JAX is the reference that it is tested against. There it is
many small operations, which cost several times as much.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import native
from dcc_jax.control import ranges
from dcc_jax.control.controller import Controller, Displacement
from dcc_jax.control.ranges import Room

Array = jax.Array


def serves(controller: Controller, torque: Array) -> bool:
    """Whether the kernel does it: in single precision, of what is static."""
    tables = controller.kp, controller.weights
    known = all(isinstance(table, np.ndarray) for table in tables)
    return known and torque.dtype == jnp.float32 and native.available()


def admittance(
    controller: Controller,
    displacement: Displacement,
    torque: Array,
    alpha: Array,
    room: Room,
) -> Displacement:
    """`compliance.admittance` of one environment; a batch by `vmap`."""
    before, coords = displacement, controller.coords
    chex.assert_shape(before.u, (coords.nq,))
    chex.assert_shape([torque, before.ud, before.y, before.yd], (coords.nv,))
    chex.assert_shape(alpha, ())
    chex.assert_shape(room.pose, (len(room.r), 4))
    call = jax.ffi.ffi_call(
        "dcc_admittance",
        [
            jax.ShapeDtypeStruct(x.shape, np.float32)
            for x in (before.u, before.ud, before.y, before.yd)
        ],
        vmap_method="broadcast_all",
    )
    given = torque, before.y, before.yd, alpha, *jax.tree.leaves(room)
    u, ud, y, yd = call(
        *(x.astype(np.float32) for x in given),
        structure=_structure(controller, len(room.r)),
        numbers=_numbers(controller),
    )
    return Displacement(u=u, ud=ud, y=y, yd=yd)


def _structure(controller: Controller, joints: int) -> np.ndarray:
    """Where scalars and quaternions lie; the last `joints` quaternions are bounded."""
    coords = controller.coords
    scalars = np.stack([coords.scalar_qpos, coords.scalar_dof], axis=-1)
    turns = np.stack([coords.quat_qpos[:, 0], coords.quat_dof[:, 0]], axis=-1)
    head = [coords.nq, coords.nv, joints, len(scalars), len(turns)]
    parts = head, scalars.ravel(), turns.ravel()
    return np.concatenate(parts).astype(np.int32)


def _numbers(controller: Controller) -> np.ndarray:
    """What is static of the law, then four numbers of each degree of freedom."""
    head = [controller.dt, ranges.LINEAR_SHARE, ranges.ROOT_ROOM]
    of_dof = controller.kp, controller.weights, controller.driven
    rows = np.stack([*of_dof, controller.return_stiffness], axis=-1)
    return np.concatenate([head, rows.ravel()]).astype(np.float32)
