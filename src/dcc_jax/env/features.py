"""The state of Sec. 4.2: where the bodies are and how they move.

Body poses come from our own kinematics on qpos, so that they can be taken of q (-) u,
of a clip and of a reset state alike, without a physics step. Everything is written for
ONE environment. `q` is the character's own part of qpos, [55].

One body contributes 18 numbers, in this order: its position (3, m), its velocity over
the last control step (3, m/s), the x and y columns of its rotation matrix (6) and their
rate (6, 1/s). All are expressed in the character's current local frame: the root
projected on the ground, turned by its heading alone. 15 bodies make 270, of which the
discriminator weighs the velocities (`env.pairs`); the policy sees log u of the 12
joints (36) on top, the paper's 306.

Departure: the paper has positions and columns now and a control step ago. Both say the
same, but there a velocity is the small difference of two numbers that are divided by
the spread of positions: it is hard to learn from, and a discriminator that is smooth,
and has noise on what it sees, hardly sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import quat
from dcc_jax.character import (
    BODIES,
    CONTROL_DT,
    Character,
    compose_scene,
    load_character,
)

Array = jax.Array

BODY_FEATURE_SIZE = 18
"""Numbers a body contributes: position and velocity, two columns and their rate."""
FEATURE_SIZE = BODY_FEATURE_SIZE * len(BODIES)
"""Of all bodies, 270."""
STATE_SIZE = FEATURE_SIZE + Character.num_joint_dofs
"""What the policy sees of it, 306 (Sec. 4.2)."""

# Row 4 i + j holds the product of the basis quaternions i and j.
_PRODUCT = np.array(
    [
        *([1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]),
        *([0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]),
        *([0, 0, 1, 0], [0, 0, 0, -1], [-1, 0, 0, 0], [0, 1, 0, 0]),
        *([0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [-1, 0, 0, 0]),
    ]
)


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The static tree of one character: a free root, ball joints, welded bodies.

    Indices are int32: jax takes them as they are, whether it is set to 64 bits or not.
    """

    coords: quat.Coordinates
    parents: np.ndarray  # [15] index of each body's parent; the root names itself
    offset: np.ndarray  # [15, 3] position in the parent's frame, m; zero for the root
    ancestors: np.ndarray  # [15, 15] one where the column's body is on the row's path
    quat_qpos: np.ndarray  # [15, 4] indices of each joint in qpos; nq on if welded
    levels: tuple[np.ndarray, ...]  # bodies by depth, the root's own level left out

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Kinematics:
        """The tree of a model that holds the character alone.

        Raises:
            ValueError: the first body has no free joint, another body has more than a
                ball joint at its origin, or is turned against its parent at rest.
        """
        bodies = range(1, model.nbody)
        for body in bodies:
            _check_body(model, body)
        parents = np.maximum(model.body_parentid[1:] - 1, 0).astype(np.int32)
        offset = model.body_pos[1:].copy()
        offset[0] = 0.0
        ancestors = np.eye(len(parents))
        for body in range(1, len(parents)):
            ancestors[body] += ancestors[parents[body]]
        depth = ancestors.sum(axis=1)
        return cls(
            coords=quat.Coordinates.of(model),
            parents=parents,
            offset=offset,
            ancestors=ancestors,
            quat_qpos=np.array([_quat_qpos(model, body) for body in bodies], np.int32),
            levels=tuple(
                np.flatnonzero(depth == d).astype(np.int32)
                for d in range(2, int(depth.max()) + 1)
            ),
        )


def _check_body(model: mujoco.MjModel, body: int) -> None:
    name = model.body(body).name
    start = model.body_jntadr[body]
    joints = list(range(start, start + model.body_jntnum[body]))
    kinds = [mujoco.mjtJoint(model.jnt_type[joint]).name for joint in joints]
    if body == 1:
        if kinds != ["mjJNT_FREE"]:
            raise ValueError(f"the root {name!r} must have one free joint, has {kinds}")
        return
    if model.body_parentid[body] == 0:
        raise ValueError(f"body {name!r} is a second root; the tree must have one")
    if kinds not in ([], ["mjJNT_BALL"]):
        raise ValueError(f"body {name!r} must have a ball joint or none, has {kinds}")
    if np.any(model.jnt_pos[joints]) or np.any(model.body_quat[body][1:]):
        raise ValueError(
            f"body {name!r} must rest unrotated, with its joint at its origin"
        )


def _quat_qpos(model: mujoco.MjModel, body: int) -> range:
    """Indices of the body's joint quaternion; welded: of an identity after qpos."""
    if model.body_jntnum[body] == 0:
        return range(model.nq, model.nq + 4)
    joint = model.body_jntadr[body]
    start = model.jnt_qposadr[joint] + (3 if body == 1 else 0)
    return range(start, start + 4)


@partial(jax.jit, static_argnums=0)  # traced once for each character
def body_poses(kinematics: Kinematics, q: Array) -> tuple[Array, Array]:
    """World positions [15, 3] in m and orientations [15, 4] of the bodies at q [55]."""
    welded = jnp.array([1.0, 0.0, 0.0, 0.0], q.dtype)
    quat_w = jnp.concatenate([q, welded])[kinematics.quat_qpos]
    for bodies in kinematics.levels:
        parent_quat = quat_w[kinematics.parents[bodies]]
        quat_w = quat_w.at[bodies].set(_compose(parent_quat, quat_w[bodies]))
    offset = jnp.asarray(kinematics.offset, q.dtype)
    bones = quat.rotate(quat_w[kinematics.parents], offset)
    ancestors = jnp.asarray(kinematics.ancestors, q.dtype)
    return q[:3] + jnp.matmul(ancestors, bones, precision="highest"), quat_w


@cache
def skeleton() -> Kinematics:
    """The tree of our character; its segments do not depend on its mass."""
    return Kinematics.of(compose_scene(load_character(), floor=False))


def body_pose(q: Array, name: str) -> tuple[Array, Array]:
    """World position [3] and orientation [4] of one body, by name, at q [55]."""
    pos_w, quat_w = body_poses(skeleton(), q)
    body = BODIES.index(name)
    return pos_w[body], quat_w[body]


def _compose(a: Array, b: Array) -> Array:
    """`quat.mul` as one outer product and one constant matrix.

    A chain of the elementwise product is fused by XLA into ever larger kernels, which
    compile four times as long and run no faster; a matrix product ends a fusion.
    """
    outer = (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], 16)
    return jnp.matmul(outer, jnp.asarray(_PRODUCT, a.dtype), precision="highest")


def local_frame(q: Array) -> tuple[Array, Array]:
    """Origin [3] and orientation [4] of the frame that features are expressed in.

    The root on the ground, z = 0, turned by the root's heading (see `quat.heading`,
    which also says what happens where the heading is undefined).
    """
    origin = q[:3] * jnp.array([1.0, 1.0, 0.0], q.dtype)
    return origin, quat.heading(q[3:7])


@partial(jax.jit, static_argnums=0)
def body_features(kinematics: Kinematics, q: Array, q_previous: Array) -> Array:
    """The bodies of one state, [270]; layout in the module docstring.

    Args:
        kinematics: the character's tree.
        q: coordinates now [55], any displacement already taken off.
        q_previous: the same, one control step ago.
    """
    pos_w, quat_w = jax.vmap(lambda q: body_poses(kinematics, q))(
        jnp.stack([q, q_previous])
    )
    origin, heading = local_frame(q)
    to_local = quat.inv(heading)
    pos = quat.rotate(to_local, pos_w - origin)
    columns = _two_columns(quat.mul(to_local, quat_w))
    (pos, then), (columns, columns_then) = pos, columns
    velocity, rate = (pos - then) / CONTROL_DT, (columns - columns_then) / CONTROL_DT
    return jnp.concatenate([pos, velocity, columns, rate], axis=-1).ravel()


def state(
    kinematics: Kinematics, q: Array, q_previous: Array, u: Array, u_previous: Array
) -> Array:
    """The paper's 306 numbers of q (-) u: `unyielded`, then log u of the joints.

    Args:
        kinematics: the character's tree.
        q: simulated coordinates now [55].
        q_previous: the same, one control step ago.
        u: displacement now [55].
        u_previous: displacement one control step ago.
    """
    bodies = unyielded(kinematics, q, q_previous, u, u_previous)
    return jnp.concatenate([bodies, quat.log_map(kinematics.coords, u)[6:]])


def unyielded(
    kinematics: Kinematics, q: Array, q_previous: Array, u: Array, u_previous: Array
) -> Array:
    """`body_features` [270] of q (-) u.

    From each pose the displacement of its own time is taken off. A character that
    follows q_m (+) u exactly then yields the features of the clip exactly, which is
    what lets undisplaced clips serve as expert (Sec. 4.2). Taking today's u off both
    would leave the motion of u itself in the velocities.

    Args:
        kinematics: the character's tree.
        q: simulated coordinates now [55].
        q_previous: the same, one control step ago.
        u: what forces have the pose away from the reference now [55]; for the
            discriminator the whole yield, see `Environment.observed`.
        u_previous: the same, one control step ago.
    """
    coords = kinematics.coords
    return body_features(
        kinematics,
        quat.ominus(coords, q, u),
        quat.ominus(coords, q_previous, u_previous),
    )


def _two_columns(orientation: Array) -> Array:
    """The x and y columns [..., 6] of the rotation matrices of quaternions [..., 4]."""
    matrix = quat.to_matrix(orientation)
    return jnp.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)
