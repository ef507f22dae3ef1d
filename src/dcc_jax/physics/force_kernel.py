"""Generalized forces of forces at points by the kernel for CPUs."""

from __future__ import annotations

import chex
import jax
import mujoco
import numpy as np

from dcc_jax.physics.quiet_mjx import mjx

Array = jax.Array


def generalized_force(
    model: mujoco.MjModel, data: mjx.Data, point_w: Array, body: Array, force_w: Array
) -> Array:
    """`step.generalized_force` of one environment; a batch by `vmap`.

    Where no force acts in a whole vector register of environments, nothing is
    calculated: most balls of `push` are in flight.
    """
    chex.assert_equal_shape([point_w, force_w])
    chex.assert_shape(force_w, (*body.shape, 3))
    call = jax.ffi.ffi_call(
        "dcc_force",
        jax.ShapeDtypeStruct((model.nv,), np.float32),
        vmap_method="broadcast_all",
    )
    tree = model.body_parentid, model.body_rootid, model.dof_bodyid
    return call(
        point_w.astype(np.float32),
        body.astype(np.int32),
        force_w.astype(np.float32),
        data.subtree_com,
        data.cdof,
        structure=np.concatenate([[model.nv, model.nbody], *tree]).astype(np.int32),
    )
