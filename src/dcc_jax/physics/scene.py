"""A compiled scene: its models, where the character lies in it, its contact slots.

Letters: C contacts, R constraint rows, nv degrees of freedom, all of one scene.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import native
from dcc_jax.character import Character
from dcc_jax.physics.kinematics_kernel import Tree
from dcc_jax.physics.newton_kernel import Layout
from dcc_jax.physics.quiet_mjx import mjx
from dcc_jax.physics.sparsity import Arrow, arrow
from dcc_jax.quat import Coordinates

Array = jax.Array


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contact slots of some bodies; `sign * force` acts on the body."""

    slots: np.ndarray  # [K] indices into the scene's C contacts
    body: np.ndarray  # [K] id of the body that is meant
    other: np.ndarray  # [K] id of what it touches
    sign: np.ndarray  # [K] of `Solution.contact_force_w` there


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene and where the character lies in it. Hashable by identity."""

    model: mujoco.MjModel  # C model, with h*kv in dof_armature and eulerdamp off
    character: Character
    coords: Coordinates
    qpos_adr: int  # of the character's free joint; it takes 55 entries from there
    dof_adr: int  # likewise in qvel, 42 entries
    newton_iterations: int
    spd_diagonal: np.ndarray  # [nv] h*kv, what `dof_armature` holds beyond the model's
    mjx_model: mjx.Model  # on the device; constants of the compiled program
    template: mjx.Data  # constant: every step starts from it, only `State` is carried
    contact_bodies: np.ndarray  # [C, 2] body ids; the force acts on the second
    moves: np.ndarray  # [nbody, nv] whether a degree of freedom moves a body
    tree: Tree  # of bodies, for the kernel of kinematics
    layout: Layout  # of degrees of freedom and rows, for the kernel of the solver
    arrow: Arrow  # where the matrices of the contact solver can be non-zero
    mass_arrow: Arrow  # where the mass matrix alone can

    @property
    def timestep(self) -> float:
        """Physics step in s."""
        return float(self.model.opt.timestep)

    def body(self, name: str) -> int:
        """Id of a body by name.

        Raises:
            ValueError: no such body in the scene.
        """
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        if name not in names:
            raise ValueError(f"unknown body {name!r}; the scene has {names}")
        return names.index(name)

    def address(self, joint: str) -> tuple[int, int]:
        """Where a joint begins in qpos and in qvel.

        Raises:
            ValueError: no such joint in the scene.
        """
        return _address(self.model, joint)

    def contacts(
        self, bodies: Sequence[int], others: Sequence[int] | None = None
    ) -> Contacts:
        """The slots in which one of `bodies` may touch one of `others`, or anything.

        Args:
            bodies: ids.
            others: ids; None: every other body.
        """
        first, second = self.contact_bodies.T
        touched = np.isin(second, bodies)
        other = np.where(touched, first, second)
        there = touched | np.isin(first, bodies)
        there &= ~np.isin(other, bodies) if others is None else np.isin(other, others)
        sign = np.where(touched, 1.0, -1.0)
        body = np.where(touched, second, first)
        return Contacts(np.flatnonzero(there), body[there], other[there], sign[there])

    def character_qpos(self, qpos: Array) -> Array:
        """The character's slice [..., 55] of qpos [..., nq]."""
        return qpos[..., self.qpos_adr : self.qpos_adr + self.character.nq]

    def character_qvel(self, qvel: Array) -> Array:
        """The character's slice [..., 42] of qvel, or of any [..., nv]."""
        return qvel[..., self.dof_adr : self.dof_adr + self.character.nv]

    def scatter_character(self, values: Array) -> Array:
        """[nv] with the character's [42] values in place and zeros elsewhere."""
        after = self.model.nv - self.dof_adr - self.character.nv
        return jnp.pad(values, (self.dof_adr, after))


def make_scene(
    model: mujoco.MjModel,
    character: Character,
    *,
    root: str = "root",
    newton_iterations: int = 8,
) -> Scene:
    """A scene ready to step, its stable PD built in.

    Args:
        model: from `character.compose_scene`; it is copied, not changed.
        character: whose gains the implicit part of the PD uses.
        root: name of the character's free joint in the model.
        newton_iterations: of the contact solver, at most (docs/performance.md).

    Raises:
        ValueError: no joint `root`, `newton_iterations` < 1, or constraints that the
            contact solver does not know.
    """
    if newton_iterations < 1:
        raise ValueError(f"newton_iterations must be >= 1, got {newton_iterations}")
    model = copy.copy(model)
    qpos_adr, dof_adr = _address(model, root)
    spd = np.zeros(model.nv)
    spd[dof_adr : dof_adr + character.nv] = model.opt.timestep * character.kv
    model.dof_armature += spd
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    native.begin()
    mjx_model = mjx.put_model(model)
    template = mjx.make_data(mjx_model)
    contacts = _contacts(mjx_model, template)
    contact_bodies = model.geom_bodyid[contacts.geom]
    pattern, rows = _row_pattern(model, contact_bodies), template._impl
    limits = int(model.jnt_limited.sum())
    known = len(pattern) == rows.nefc and limits == rows.nl and rows.nf == 0
    if not known or np.any(contacts.dim != 3):
        raise ValueError(
            "the contact solver knows contacts of condim 3, limits of joints, and the "
            "equalities connect and weld; the model has other constraints (friction "
            "loss, tendons, other equalities or condims), or switches these off"
        )
    return Scene(
        model=model,
        character=character,
        coords=Coordinates.of(model),
        qpos_adr=qpos_adr,
        dof_adr=dof_adr,
        newton_iterations=newton_iterations,
        spd_diagonal=spd,
        mjx_model=mjx_model,
        template=template,
        contact_bodies=contact_bodies,
        moves=np.array([_chain(model, body) for body in range(model.nbody)]),
        tree=Tree.of(model, contacts),
        layout=Layout.of(model, contacts, template._impl.ne),
        arrow=arrow(model, pattern),
        mass_arrow=arrow(model, np.zeros((0, model.nv), bool)),
    )


def _address(model: mujoco.MjModel, joint: str) -> tuple[int, int]:
    names = [model.joint(i).name for i in range(model.njnt)]
    if joint not in names:
        raise ValueError(f"unknown joint {joint!r}; the scene has {names}")
    found = model.joint(joint)
    return int(found.qposadr[0]), int(found.dofadr[0])


def _contacts(mjx_model: mjx.Model, template: mjx.Data) -> mjx.Contact:
    """MJX's contact slots, as numpy; all but where they are is static."""
    found = jax.jit(lambda: mjx.collision(mjx_model, template)._impl.contact)()
    return jax.tree.map(np.asarray, found)


def _row_pattern(model: mujoco.MjModel, contact_bodies: np.ndarray) -> np.ndarray:
    """[R, nv] where MJX's constraint rows can be non-zero, in its order of rows."""
    rows = []
    order = (mujoco.mjtEq.mjEQ_CONNECT, 3), (mujoco.mjtEq.mjEQ_WELD, 6)
    for kind, count in order:
        for i in np.flatnonzero(model.eq_type == kind):
            one, other = model.eq_obj1id[i], model.eq_obj2id[i]
            if model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
                one, other = model.site_bodyid[[one, other]]
            rows += [_chain(model, one) | _chain(model, other)] * count
    for i in np.flatnonzero(model.jnt_limited):
        row = np.zeros(model.nv, bool)
        row[model.dof_jntid == i] = True
        rows.append(row)
    for one, other in contact_bodies:
        rows += [_chain(model, one) | _chain(model, other)] * 4
    return np.array(rows, bool).reshape(-1, model.nv)


def _chain(model: mujoco.MjModel, body: int) -> np.ndarray:
    """[nv] the degrees of freedom that move a body."""
    moves = np.zeros(model.nv, bool)
    while body:
        start = model.body_dofadr[body]
        moves[start : start + model.body_dofnum[body]] = True
        body = model.body_parentid[body]
    return moves
