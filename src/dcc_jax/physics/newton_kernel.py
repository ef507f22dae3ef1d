"""The contact solver's kernel for CPUs: what it is given, and the call.

It makes the mass matrix and the rows of the contacts itself: written out as the solver
in JAX has them, they cost more than to solve with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax.physics.quiet_mjx import mjx
from dcc_jax.physics.sparsity import Arrow

Array = jax.Array


@flax.struct.dataclass
class Problem:
    """What the kernel makes mass matrix and constraint rows of.

    E rows are of equalities and limits, the other four of each of C contacts.
    """

    inertia: Array  # [nbody, 10] of the composite bodies, about their tree's centre
    motion: Array  # [nv, 6] axes, angular then linear, about the same
    center_w: Array  # [nbody, 3] m, centre of mass of what hangs on each body
    qvel: Array  # [nv]
    smooth: Array  # [nv] all generalized forces but those of constraints
    start: Array  # [nv] accelerations to start from
    J: Array  # [E, nv]
    D: Array  # [E] inverse regularization
    aref: Array  # [E] reference acceleration
    dist: Array  # [C] m, negative where the geoms of a contact overlap
    frame_w: Array  # [C, 3, 3] normal and two tangents
    point_w: Array  # [C, 3] m


def problem(model: mjx.Model, data: mjx.Data, smooth: Array, start: Array) -> Problem:
    """Of a state with its kinematics, composite inertias and contacts."""
    contact = data._impl.contact
    without = contact.replace(dim=np.zeros_like(contact.dim))
    data = data.tree_replace({"_impl.contact": without})
    rows = mjx.make_constraint(model, data)._impl
    return Problem(
        inertia=data._impl.crb,
        motion=data.cdof,
        center_w=data.subtree_com,
        qvel=data.qvel,
        smooth=smooth,
        start=start,
        J=rows.efc_J,
        D=rows.efc_D,
        aref=rows.efc_aref,
        dist=contact.dist,
        frame_w=contact.frame,
        point_w=contact.pos,
    )


def newton(
    shape: Arrow, layout: Layout, given: Problem, iterations: int
) -> tuple[Array, Array]:
    """`contact_solver.newton` of one environment; a batch by `vmap`.

    Args:
        shape: of the scene's matrices.
        layout: of its degrees of freedom and contacts.
        given: what to solve.
        iterations: the most Newton iterations.
    """
    call = jax.ffi.ffi_call(
        "dcc_newton",
        (
            jax.ShapeDtypeStruct((shape.nv,), np.float32),
            jax.ShapeDtypeStruct((shape.num_rows,), np.float32),
        ),
        vmap_method="broadcast_all",
    )
    qacc, force = call(
        *(x.astype(np.float32) for x in jax.tree.leaves(given)),
        jnp.asarray(iterations, jnp.int32),
        structure=_packed(shape, layout),
        numbers=np.concatenate([layout.armature, layout.contacts.ravel()]),
    )
    return qacc, force


@dataclass(frozen=True, eq=False)
class Layout:
    """What is static of a scene's degrees of freedom and rows."""

    num_bodies: int
    num_equality: int  # rows, the first
    num_contacts: int  # C; four rows each, the last
    parent: np.ndarray  # [nv] dof, -1: none
    body: np.ndarray  # [nv] that a dof moves
    root: np.ndarray  # [nv] first body of its tree
    last: np.ndarray  # [C, 2] last dof that moves each body of a contact, -1: none
    armature: np.ndarray  # [nv]
    contacts: np.ndarray  # [C, 11] what is constant of each contact's rows

    @classmethod
    def of(
        cls, model: mujoco.MjModel, contacts: mjx.Contact, num_equality: int
    ) -> Layout:
        """Of a model and its contact slots, as numpy."""
        bodies = model.geom_bodyid[contacts.geom]
        last = [_last_dof(model, body) for body in bodies.ravel()]
        return cls(
            num_bodies=model.nbody,
            num_equality=num_equality,
            num_contacts=len(bodies),
            parent=model.dof_parentid,
            body=model.dof_bodyid,
            root=model.body_rootid[model.dof_bodyid],
            last=np.array(last, int).reshape(-1, 2),
            armature=model.dof_armature.astype(np.float32),
            contacts=_constants(model, contacts, bodies).astype(np.float32),
        )


def _constants(
    model: mujoco.MjModel, contacts: mjx.Contact, bodies: np.ndarray
) -> np.ndarray:
    """[C, 11] in the kernel's order: margin, friction, what weighs the regularization,
    stiffness, damping, and five of the impedance (MuJoCo, "solver parameters").

    The rows of a contact are the edges of MuJoCo's friction pyramid, normal +- mu
    tangent. All four have the same regularization, damping and stiffness (condim 3).
    """
    friction = contacts.friction[:, :2]
    square = friction[:, 0] ** 2
    weight = model.body_invweight0[bodies, 0].sum(axis=1)
    weight = 2.0 * square * (1.0 + square) * weight / model.opt.impratio
    first, ratio = contacts.solref.T
    time = first
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        time = np.maximum(time, 2.0 * model.opt.timestep)
    low, high, width, middle, power = contacts.solimp.T
    least, most = mujoco.mjMINIMP, mujoco.mjMAXIMP
    low, high, middle = (np.clip(x, least, most) for x in (low, high, middle))
    width, power = np.maximum(width, mujoco.mjMINVAL), np.maximum(power, 1.0)
    # Numbers that are not positive are stiffness and damping themselves.
    with np.errstate(divide="ignore"):
        stiffness = np.where(
            first > 0.0, 1.0 / np.square(high * time * ratio), -first / high**2
        )
        damping = np.where(ratio > 0.0, 2.0 / (high * time), -ratio / high)
    impedance = low, high, width, middle, power
    columns = contacts.includemargin, *friction.T, weight, stiffness, damping
    return np.stack([*columns, *impedance], axis=1)


def _last_dof(model: mujoco.MjModel, body: int) -> int:
    while body and not model.body_dofnum[body]:
        body = model.body_parentid[body]
    return model.body_dofadr[body] + model.body_dofnum[body] - 1 if body else -1


def _packed(shape: Arrow, layout: Layout) -> np.ndarray:
    """Layout and arrow as numbers: every limb, then the core, padding left out."""
    core = shape.core[shape.core < shape.nv]
    parts = []
    for stack in shape.stacks:
        for dofs, coupled, rows in zip(stack.dofs, stack.core, stack.rows, strict=True):
            dofs, rows = dofs[dofs < shape.nv], rows[rows < shape.num_rows]
            coupled = coupled[coupled < len(core)]
            counts = [len(dofs), len(coupled), len(rows)]
            parts += [counts, dofs, core[coupled], coupled, rows]
    parts += [[len(core), 0, len(shape.core_rows)], core, shape.core_rows]
    given = shape.num_rows - 4 * layout.num_contacts
    head = [shape.nv, shape.num_rows, layout.num_equality, given, layout.num_bodies]
    dofs = layout.parent, layout.body, layout.root, layout.last.ravel()
    count = [sum(len(stack.dofs) for stack in shape.stacks) + 1]
    return np.concatenate([head, *dofs, count, *parts]).astype(np.int32)
