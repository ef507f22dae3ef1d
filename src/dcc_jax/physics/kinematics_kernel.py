"""Kinematics, composite inertias, bias forces and contacts by the kernel for CPUs.

What MJX's stages compute, in one call: they are the reference that it is tested
against. In XLA they are two thirds of the program of a physics step, and take longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import mujoco
import numpy as np

from dcc_jax.physics.quiet_mjx import mjx

Array = jax.Array

FIELDS = (
    ("xpos", "nbody", (3,)),
    ("xquat", "nbody", (4,)),
    ("xmat", "nbody", (3, 3)),
    ("xipos", "nbody", (3,)),
    ("geom_xpos", "ngeom", (3,)),
    ("geom_xmat", "ngeom", (3, 3)),
    ("site_xpos", "nsite", (3,)),
    ("site_xmat", "nsite", (3, 3)),
    ("subtree_com", "nbody", (3,)),
    ("cdof", "nv", (6,)),
    ("_impl.crb", "nbody", (10,)),
    ("qfrc_bias", "nv", ()),
)
"""What the kernel fills in of `mjx.Data`, in its order: name, count, shape of each."""


CONTACT_FIELDS = (("dist", ()), ("pos", (3,)), ("frame", (3, 3)))
"""Likewise of its contacts, if the kernel knows them all."""

GEOM = mujoco.mjtGeom
PAIRS = (
    (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_SPHERE),
    (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_CAPSULE),
    (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_SPHERE),
    (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CAPSULE),
    (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_BOX),
    (GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_CAPSULE),
    (GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_BOX),
)
"""Types of two geoms that the kernel collides, in its order of kinds."""
TWICE = PAIRS[1], PAIRS[6]
"""Those of them that touch in two places."""


@dataclass(frozen=True, eq=False)
class Tree:
    """What is static of a scene's bodies, packed for the kernel."""

    structure: np.ndarray  # [n] int32
    numbers: np.ndarray  # [m] float32, lengths in m, masses in kg
    shapes: dict[str, tuple[int, ...]]  # of what it fills in; geoms if MJX collides
    contacts: mjx.Contact  # what is static of the scene's
    collides: bool  # whether the kernel knows every pair of geoms that may touch

    @classmethod
    def of(cls, model: mujoco.MjModel, contacts: mjx.Contact) -> Tree:
        """Of a model and its contact slots, in the order in which the kernel reads."""
        pairs = _pairs(model, contacts)
        counts = [model.nq, model.nv, model.nmocap, model.nbody]
        structure = [*counts, model.ngeom, model.nsite, len(pairs or ())]
        weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        numbers = [np.zeros(3) if weightless else model.opt.gravity]
        for b in range(model.nbody):
            body = model.body(b)
            joints = range(int(body.jntadr[0]), int(body.jntadr[0] + body.jntnum[0]))
            structure += [model.body_parentid[b], model.body_rootid[b]]
            structure += [model.body_mocapid[b], len(joints)]
            numbers += [body.pos, body.quat, body.ipos, body.iquat]
            numbers += [body.inertia, body.mass]
            for j in joints:
                structure.append(model.jnt_type[j])
                zero = model.qpos0[model.jnt_qposadr[j]]
                numbers += [model.jnt_pos[j], model.jnt_axis[j], [zero]]
        for g in range(model.ngeom):
            structure.append(model.geom_bodyid[g])
            numbers += [model.geom_pos[g], model.geom_quat[g], model.geom_size[g]]
        for s in range(model.nsite):
            structure.append(model.site_bodyid[s])
            numbers += [model.site_pos[s], model.site_quat[s], model.site_size[s]]
        for pair in pairs or ():
            structure += pair
        return cls(
            structure=np.array(structure, np.int32),
            numbers=np.concatenate(numbers).astype(np.float32),
            shapes={
                name: (getattr(model, n), *each)
                for name, n, each in FIELDS
                if pairs is None or n != "ngeom"
            },
            contacts=contacts,
            collides=pairs is not None,
        )


def _pairs(
    model: mujoco.MjModel, contacts: mjx.Contact
) -> list[tuple[int, int, int]] | None:
    """Kind and geoms of each pair; None if the kernel does not know all of them.

    A pair that has two slots has them one after the other.
    """
    pairs, slot = [], 0
    while slot < len(contacts.geom):
        geoms = contacts.geom[slot]
        types = tuple(GEOM(kind) for kind in model.geom_type[geoms])
        if types not in PAIRS:
            return None
        pairs.append((PAIRS.index(types), *geoms))
        slot += 2 if types in TWICE else 1
    return pairs


def kinematics(tree: Tree, data: mjx.Data) -> mjx.Data:
    """Poses, axes, inertias, bias forces and contacts of a state; a batch by `vmap`.

    Contacts are left to MJX if not `tree.collides`.

    Args:
        tree: of the scene.
        data: with qpos, qvel and the poses of mocap bodies, single precision.
    """
    contacts = len(tree.contacts.geom) if tree.collides else 0
    shapes = [tree.shapes.get(name, (0, *each)) for name, _, each in FIELDS]
    shapes += [(contacts, *each) for _, each in CONTACT_FIELDS]
    call = jax.ffi.ffi_call(
        "dcc_kinematics",
        [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes],
        vmap_method="broadcast_all",
    )
    given = data.qpos, data.qvel, data.mocap_pos, data.mocap_quat
    made = call(
        *(x.astype(np.float32) for x in given),  # where jax is told of double precision
        structure=tree.structure,
        numbers=tree.numbers,
    )
    fields = zip(FIELDS, made[: len(FIELDS)], strict=True)
    filled = {name: value for (name, *_), value in fields if name in tree.shapes}
    if tree.collides:
        names = [name for name, _ in CONTACT_FIELDS]
        found = dict(zip(names, made[len(FIELDS) :], strict=True))
        filled["_impl.contact"] = tree.contacts.replace(**found)
    return data.tree_replace(filled)
