"""The physics of one scene: one step and what a step needs.

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

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import native, quat
from dcc_jax.physics import force_kernel, kinematics_kernel, newton_kernel
from dcc_jax.physics.contact_solver import Rows, newton, solve_mass
from dcc_jax.physics.quiet_mjx import mjx
from dcc_jax.physics.scene import Scene

Array = jax.Array
_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_NO_SPRING = mujoco.mjtDisableBit.mjDSBL_SPRING
_NO_DAMPER = mujoco.mjtDisableBit.mjDSBL_DAMPER


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
    """What follows from positions and velocities alone.

    Of `data`, without the kernel, all that MJX's stages have; with it, those fields
    that `kinematics_kernel.FIELDS` names, and the contacts. Where the kernel collides,
    poses of geoms are not among them.
    """

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
    """Poses, axes, composite inertias, bias forces and contacts of a state."""
    model = scene.mjx_model
    data = scene.template.replace(qpos=state.qpos, qvel=state.qvel)
    if world is not None:
        data = data.replace(
            mocap_pos=world.mocap_pos,
            mocap_quat=world.mocap_quat,
            eq_active=world.equality_active,
        )
    if _native(scene, state):
        data = kinematics_kernel.kinematics(scene.tree, data)
    else:
        stages = mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne
        for stage in stages:
            data = stage(model, data)
    if not (_native(scene, state) and scene.tree.collides):
        data = mjx.collision(model, data)
    return Kinematics(data=data)


def _native(scene: Scene, state: State) -> bool:
    """Whether the kernels do it: in single precision, and where there is no fluid."""
    single = state.qpos.dtype == jnp.float32
    fluid = scene.mjx_model.opt._impl.has_fluid_params
    return single and not fluid and native.available()


def solve(scene: Scene, kin: Kinematics, state: State, qfrc: Array) -> Solution:
    """Accelerations under applied generalized forces, contacts and equalities.

    M(q) qdd + c(q, qd) = tau + tau_ext, Eq. (1), with the contacts' share of tau_ext
    found along with qdd.

    Args:
        scene: the scene.
        kin: of the same state.
        state: positions, velocities and the last accelerations.
        qfrc: applied generalized forces [nv], N and N m.
    """
    model, data = scene.mjx_model, kin.data
    smooth = qfrc + _passive(scene, data) - data.qfrc_bias
    if _native(scene, state):
        given = newton_kernel.problem(model, data, smooth, state.qacc)
        qacc, force = newton_kernel.newton(
            scene.arrow, scene.layout, given, scene.newton_iterations
        )
    else:
        data = mjx.make_constraint(model, data)
        rows = Rows(
            J=data._impl.efc_J,
            D=data._impl.efc_D,
            aref=data._impl.efc_aref,
            num_equality=data._impl.ne,
        )
        mass = mass_matrix(scene, kin)
        qacc, force = newton(
            scene.arrow, mass, smooth, rows, state.qacc, scene.newton_iterations
        )
    contact_force_w, contact_point_w = _contact_forces(data, force)
    return Solution(
        qacc=qacc,
        contact_force_w=contact_force_w,
        contact_point_w=contact_point_w,
        equality_force=force[: scene.layout.num_equality],
    )


def _passive(scene: Scene, data: mjx.Data) -> Array:
    """Forces [nv] of dampers, and of the springs of slides and hinges.

    MJX has all else that is passive, but takes logarithms of joints without a spring.
    """
    model, dtype = scene.model, data.qvel.dtype
    off = model.opt.disableflags
    sprung = np.flatnonzero(model.jnt_stiffness * (not off & _NO_SPRING))
    damping = model.dof_damping * (not off & _NO_DAMPER)
    turning = np.isin(model.jnt_type[sprung], (_FREE, _BALL)).any()
    fluid = scene.mjx_model.opt._impl.has_fluid_params
    if turning or fluid or model.ntendon or model.body_gravcomp.any():
        return mjx.passive(scene.mjx_model, data).qfrc_passive
    force = -jnp.asarray(damping, dtype) * data.qvel
    if len(sprung):
        at = model.jnt_qposadr[sprung]
        stretch = data.qpos[at] - jnp.asarray(model.qpos_spring[at], dtype)
        pull = jnp.asarray(model.jnt_stiffness[sprung], dtype) * stretch
        force = force.at[model.jnt_dofadr[sprung]].add(-pull)
    return force


def _contact_forces(data: mjx.Data, force: Array) -> tuple[Array, Array]:
    """World forces [C, 3] and points [C, 3] from pyramid edge forces.

    The pyramid of a condim-3 contact has four edges: normal +- mu tangent. Their rows
    are the last ones.
    """
    contact = data._impl.contact
    count = contact.pos.shape[0]
    edges = force[force.shape[0] - 4 * count :].reshape(count, 4)
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
    data = kin.data
    center_w = data.subtree_com[jnp.asarray(scene.mjx_model.body_rootid)[body]]
    speed = data.cdof[:, 3:] + jnp.cross(data.cdof[:, :3], point_w - center_w)
    return (speed * jnp.asarray(scene.moves)[body][:, None]).T


def generalized_force(
    scene: Scene, kin: Kinematics, point_w: Array, body: Array, force_w: Array
) -> Array:
    """J^T f [nv], N and N m, of forces at points that are fixed to bodies, summed.

    What `point_jacobian` says, without J: a force and its moment about the centre of
    mass of the kinematic tree do work along each motion `cdof` of the bodies it moves.

    Args:
        scene: static.
        kin: of the state.
        point_w: m, world [F, 3].
        body: ids [F].
        force_w: N, world [F, 3].
    """
    data = kin.data
    if data.cdof.dtype == jnp.float32 and native.available():
        return force_kernel.generalized_force(
            scene.model, data, point_w, jnp.asarray(body), force_w
        )
    center_w = data.subtree_com[jnp.asarray(scene.mjx_model.body_rootid)[body]]
    wrench = jnp.concatenate([jnp.cross(point_w - center_w, force_w), force_w], axis=-1)
    moved = jnp.asarray(scene.moves)[body].astype(wrench.dtype)
    if len(wrench) == 1:
        # As a product of matrices XLA would make the wrench anew for every entry.
        return jnp.sum((wrench @ data.cdof.T) * moved, axis=0)
    return jnp.sum((moved.T @ wrench) * data.cdof, axis=-1)


def mass_matrix(scene: Scene, kin: Kinematics) -> Array:
    """M [nv, nv], kg, kg m and kg m^2, with h*kv and armature on its diagonal.

    M_ij is the momentum of i's composite body along i, times the motion of its ancestor
    j: composite rigid bodies.
    """
    data, body = kin.data, scene.model.dof_bodyid
    momentum = _momentum(data._impl.crb[body], data.cdof)
    lower = jnp.tril((momentum @ data.cdof.T) * scene.moves[body])
    armature = jnp.asarray(scene.model.dof_armature, lower.dtype)
    return lower + jnp.tril(lower, -1).T + jnp.diag(armature)


def _momentum(inertia: Array, motion: Array) -> Array:
    """[nv, 6] of bodies with spatial inertias [nv, 10] that move along [nv, 6]."""
    matrix = inertia[:, np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]
    offset, mass = inertia[:, 6:9], inertia[:, 9:]
    turning, moving = motion[:, :3], motion[:, 3:]
    spin = jnp.sum(matrix * turning[:, None], axis=-1) + jnp.cross(offset, moving)
    return jnp.concatenate([spin, mass * moving - jnp.cross(offset, turning)], axis=-1)


def mass_solve(scene: Scene, kin: Kinematics, qfrc: Array) -> Array:
    """M^-1 qfrc with the true mass matrix (no h*kv), for qfrc [nv] or [F, nv].

    With qfrc = J^T f this is FD(q, qd, f) - FD(q, qd, 0) of Alg. 1, because forward
    dynamics is linear in the external force.
    """
    mass = mass_matrix(scene, kin)
    solved = solve_mass(
        scene.mass_arrow, mass, scene.spd_diagonal, jnp.atleast_2d(qfrc)
    )
    return solved.reshape(qfrc.shape)
