"""The physics of one scene: the only module that calls MJX.

One step is read as it runs:

    kin = kinematics(scene, state)                     # where everything is
    solution = solve(scene, kin, state, qfrc)          # accelerations and forces
    state = integrate(scene, state, solution)          # semi-implicit Euler

`qfrc` are the generalized forces of the controller and of pushes. The stable PD of
Sec. 5.1 costs nothing: `make_scene` adds h*kv to the diagonal of the mass matrix, so
the one factorization of a step is that of M + h Kv (`control.pd` has the other half).
`mass_solve` uses the true mass matrix, without it.

Letters: C contacts, E equality constraints, nv degrees of freedom, all of one scene.
Every function is for ONE environment; callers vmap.
"""

from __future__ import annotations

import contextlib
import copy
import io
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import quat
from dcc_jax.character import Character
from dcc_jax.quat import Coordinates
from dcc_jax.solver import Rows, newton, solve_mass
from dcc_jax.sparsity import Arrow, arrow

with contextlib.redirect_stdout(io.StringIO()):
    # It prints that Warp is missing, which only CUDA could use.
    from mujoco import mjx

Array = jax.Array


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
        ValueError: no joint `root`, or `newton_iterations` < 1.
    """
    names = [model.joint(i).name for i in range(model.njnt)]
    if root not in names:
        raise ValueError(f"unknown root joint {root!r}; the scene has {names}")
    if newton_iterations < 1:
        raise ValueError(f"newton_iterations must be >= 1, got {newton_iterations}")
    model = copy.copy(model)
    dof_adr = int(model.joint(root).dofadr[0])
    spd = np.zeros(model.nv)
    spd[dof_adr : dof_adr + character.nv] = model.opt.timestep * character.kv
    model.dof_armature += spd
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    mjx_model = mjx.put_model(model)
    template = mjx.make_data(mjx_model)
    contact_bodies = _contact_bodies(model, mjx_model, template)
    return Scene(
        model=model,
        character=character,
        coords=Coordinates.of(model),
        qpos_adr=int(model.joint(root).qposadr[0]),
        dof_adr=dof_adr,
        newton_iterations=newton_iterations,
        spd_diagonal=spd,
        mjx_model=mjx_model,
        template=template,
        contact_bodies=contact_bodies,
        arrow=arrow(model, _row_pattern(model, contact_bodies)),
        mass_arrow=arrow(model, np.zeros((0, model.nv), bool)),
    )


def _contact_bodies(
    model: mujoco.MjModel, mjx_model: mjx.Model, template: mjx.Data
) -> np.ndarray:
    """[C, 2] bodies of MJX's contact slots.

    Their geoms are constants of the traced program; the rest of it is never computed.
    """
    geoms = jax.jit(lambda: mjx.collision(mjx_model, template)._impl.contact.geom)()
    return model.geom_bodyid[np.asarray(geoms)]


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


@flax.struct.dataclass
class State:
    """What the physics carries from step to step, and nothing else."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    qacc: Array  # [nv] of the last step, where the contact solver starts


@flax.struct.dataclass
class World:
    """What the scene's surroundings do in a step: kinematic bodies and switches."""

    mocap_pos: Array  # [nmocap, 3] m, world
    mocap_quat: Array  # [nmocap, 4]
    equality_active: Array  # [E] bool


@flax.struct.dataclass
class Kinematics:
    """Everything that depends on positions alone."""

    data: mjx.Data

    @property
    def body_pos(self) -> Array:
        """[nbody, 3] m, world; entry 0 is the world body."""
        return self.data.xpos

    @property
    def body_quat(self) -> Array:
        """[nbody, 4]."""
        return self.data.xquat

    @property
    def body_center(self) -> Array:
        """Centres of mass [nbody, 3] m, world."""
        return self.data.xipos


@flax.struct.dataclass
class Solution:
    """Accelerations of a step and the constraint forces that go with them."""

    qacc: Array  # [nv]
    contact_force_w: Array  # [C, 3] N on the second body of `Scene.contact_bodies`
    contact_point_w: Array  # [C, 3] m
    equality_force: Array  # [rows of equalities] N or N m, MuJoCo's row order


def initial_state(scene: Scene, qpos: Array, qvel: Array) -> State:
    """A state from coordinates [nq] and velocities [nv]; needs no physics."""
    return State(qpos=qpos, qvel=qvel, qacc=jnp.zeros(scene.model.nv, qvel.dtype))


def default_world(scene: Scene) -> World:
    """The surroundings as the model declares them."""
    data = scene.template
    return World(data.mocap_pos, data.mocap_quat, data.eq_active.astype(bool))


def kinematics(scene: Scene, state: State, world: World | None = None) -> Kinematics:
    """Poses, motion axes, mass matrix, contacts and constraint rows of a state."""
    model = scene.mjx_model
    data = scene.template.replace(qpos=state.qpos, qvel=state.qvel)
    if world is not None:
        data = data.replace(
            mocap_pos=world.mocap_pos,
            mocap_quat=world.mocap_quat,
            eq_active=world.equality_active,
        )
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.crb(model, data)
    data = mjx.collision(model, data)
    data = mjx.make_constraint(model, data)
    return Kinematics(data=data)


def solve(scene: Scene, kin: Kinematics, state: State, qfrc: Array) -> Solution:
    """Accelerations under applied generalized forces, contacts and equalities.

    Args:
        scene: the scene.
        kin: of the same state.
        state: positions, velocities and the last accelerations.
        qfrc: applied generalized forces [nv], N and N m.
    """
    model, data = scene.mjx_model, kin.data
    data = mjx.com_vel(model, data)
    data = mjx.passive(model, data)
    data = mjx.rne(model, data)
    smooth = qfrc + data.qfrc_passive - data.qfrc_bias
    rows = Rows(
        J=data._impl.efc_J,
        D=data._impl.efc_D,
        aref=data._impl.efc_aref,
        num_equality=data._impl.ne,
    )
    mass = mjx.full_m(model, data)
    qacc, force = newton(
        scene.arrow, mass, smooth, rows, state.qacc, scene.newton_iterations
    )
    contact_force_w, contact_point_w = _contact_forces(data, force)
    return Solution(
        qacc=qacc,
        contact_force_w=contact_force_w,
        contact_point_w=contact_point_w,
        equality_force=force[: data._impl.ne],
    )


def _contact_forces(data: mjx.Data, force: Array) -> tuple[Array, Array]:
    """World forces [C, 3] and points [C, 3] from pyramid edge forces.

    The pyramid of a condim-3 contact has four edges: normal +- mu tangent.
    """
    contact = data._impl.contact
    edges = force[contact.efc_address[:, None] + np.arange(4)]
    friction = contact.friction[:, :2]
    tangents = friction * (edges[:, 0::2] - edges[:, 1::2])
    local = jnp.concatenate([edges.sum(-1, keepdims=True), tangents], axis=-1)
    return jnp.sum(local[:, :, None] * contact.frame, axis=1), contact.pos


def integrate(scene: Scene, state: State, solution: Solution) -> State:
    """Semi-implicit Euler (Sec. 3.1): first the velocities, then the positions."""
    h = scene.timestep
    qvel = state.qvel + h * solution.qacc
    qpos = quat.integrate(scene.coords, state.qpos, qvel, h)
    return State(qpos=qpos, qvel=qvel, qacc=solution.qacc)


def point_jacobian(scene: Scene, kin: Kinematics, point_w: Array, body: Array) -> Array:
    """J [3, nv] of a point [3] (m, world) fixed to a body (id): v_w = J qvel."""
    jac, _ = mjx.jac(scene.mjx_model, kin.data, point_w, body)
    return jac.T


def mass_solve(scene: Scene, kin: Kinematics, qfrc: Array) -> Array:
    """M^-1 qfrc with the true mass matrix (no h*kv), for qfrc [nv] or [F, nv].

    With qfrc = J^T f this is FD(q, qd, f) - FD(q, qd, 0) of Alg. 1, because forward
    dynamics is linear in the external force.
    """
    mass = mjx.full_m(scene.mjx_model, kin.data)
    solved = solve_mass(
        scene.mass_arrow, mass, scene.spd_diagonal, jnp.atleast_2d(qfrc)
    )
    return solved.reshape(qfrc.shape)
