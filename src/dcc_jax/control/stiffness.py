"""The work-space stiffness of a PD-controlled mechanism (Sec. 3.2, Fig. 2).

K = -df/dx, Eq. (3): the force f with which a mechanism answers when a point of it is
moved by x. Plain functions on any `mujoco.MjModel`, outside jit, in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

STIFFNESS_LIMIT = 1e9
"""N/m. A direction in which no joint lets the point move is infinitely stiff (a
straight arm along itself, a planar arm across its plane); its stiffness is cut here,
far above any finite one, so that K stays a matrix of numbers."""


def stiffness(
    mj_model: mujoco.MjModel,
    qpos: np.ndarray | Sequence[float],
    body: str,
    point: np.ndarray | Sequence[float] = (0.0, 0.0, 0.0),
    kp: float | np.ndarray | Sequence[float] | None = None,
    *,
    root: bool = False,
) -> np.ndarray:
    """K = kp (J J^T)^-1, Eq. (4): force per displacement of a point held by PD.

    With gains that differ by joint it is K = (J Kp^-1 J^T)^-1, of which Eq. (4) is the
    case of equal gains. Directions that cannot move are cut at `STIFFNESS_LIMIT`.

    Args:
        mj_model: any MuJoCo model with at least one joint.
        qpos: the pose [nq].
        body: name of the body on which the point lies.
        point: in the body's frame, m.
        kp: proportional gain, N m/rad (N/m for slides): one number or one for every
            velocity [nv]; infinite for a locked joint. Default 1: K is then L.
        root: count the velocities of free joints as driven by PD too. They are not, in
            a character, and are left out by default.

    Returns:
        K [3, 3], N/m, world frame, symmetric and positive definite.

    Raises:
        ValueError: a model without joints, an unknown body or one that no counted joint
            moves, a wrong shape, a number that is not finite, a gain that is not
            positive.
    """
    body_id = _body_id(mj_model, body)
    if mj_model.njnt == 0:
        raise ValueError("the model has no joints; its stiffness is infinite")
    J = _jacobian(
        mj_model,
        _numbers("qpos", qpos, mj_model.nq),
        body_id,
        _numbers("point", point, 3),
    )
    driven = np.full(mj_model.nv, True) if root else ~_free_dofs(mj_model)
    J = J[:, driven]
    if not np.any(J):
        raise ValueError(
            f"no joint{'' if root else ' but a free one'} moves body {body!r}: "
            "its stiffness is infinite"
        )
    compliance = (J / _gains(mj_model.nv, kp, driven)) @ J.T
    yields, axes = np.linalg.eigh(compliance)
    return (axes / np.maximum(yields, 1.0 / STIFFNESS_LIMIT)) @ axes.T


def softened_gains(kp: np.ndarray, weights: np.ndarray, alpha: float) -> np.ndarray:
    """Gains [nv] that have a mechanism rest where the law `admittance` has it rest.

    kp / (1 + w alpha / (1 - alpha)), joint by joint; at weight 1 it is kp (1 - alpha)
    and `stiffness` of it Eq. (7).

    Args:
        kp: proportional gains [nv], N m/rad.
        weights: of the columns of J [nv] (Sec. 5.1).
        alpha: level of compliance, 0 to 1, exclusive.

    Raises:
        ValueError: an alpha outside [0, 1).
    """
    if not 0.0 <= alpha < 1.0:
        raise ValueError(f"alpha must be in [0, 1), got {alpha}")
    return kp / (1.0 + weights * alpha / (1.0 - alpha))


def modulated_stiffness(K: np.ndarray, alpha: float) -> np.ndarray:
    """K_hat = (1 - alpha) K, Eq. (7): what the compliance controller leaves of K.

    Eq. (5) is the stiffness where the target q_bar moves along,
    kp (L - J^-T dq_bar/dx), and Eq. (6) the choice dq_bar/dx = alpha J^T L.

    It is reached by the laws `measured` and, at equal weights, `admittance`; see
    `dcc_jax.control.compliance` for the conditions.

    Args:
        K: stiffness [3, 3], N/m.
        alpha: level of compliance, 0 to 1.

    Raises:
        ValueError: an alpha outside [0, 1], a K that is no finite symmetric [3, 3].
    """
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"alpha must be in [0, 1], got {alpha}")
    return (1.0 - alpha) * _symmetric(K)


def determinant(K: np.ndarray) -> float:
    """The scalar stiffness k = det(K) of Sec. 3.2, (N/m)^3.

    Raises:
        ValueError: a K that is no finite symmetric [3, 3].
    """
    return float(np.linalg.det(_symmetric(K)))


def ellipsoid(K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of a stiffness and the stiffness along each (Fig. 2).

    Args:
        K: stiffness [3, 3], N/m.

    Returns:
        axes: [3, 3], one unit axis a column, world frame, right-handed.
        radii: [3], N/m, ascending: the first axis is the most compliant.

    Raises:
        ValueError: a K that is no finite symmetric [3, 3].
    """
    radii, axes = np.linalg.eigh(_symmetric(K))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes, radii


def deflection(
    K: np.ndarray, force: np.ndarray | Sequence[float], alpha: float = 0.0
) -> np.ndarray:
    """Where a small constant force takes the point at last, x = K_hat^-1 f, m [3].

    Eq. (3) the other way round, with the K_hat of Eq. (7).

    Args:
        K: stiffness [3, 3], N/m.
        force: N, world frame [3].
        alpha: level of compliance, 0 to 1, exclusive: at 1 nothing holds the point.

    Raises:
        ValueError: a force that is not three finite numbers, an alpha outside [0, 1).
    """
    force = _numbers("force", force, 3)
    if alpha == 1.0:
        raise ValueError("alpha must be below 1 for a deflection, got 1")
    return np.linalg.solve(modulated_stiffness(K, alpha), force)


def _body_id(model: mujoco.MjModel, body: str) -> int:
    names = [model.body(i).name for i in range(1, model.nbody)]
    if body not in names:
        raise ValueError(f"body must be one of {names}, got {body!r}")
    return 1 + names.index(body)


def _free_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Which velocities [nv] belong to free joints."""
    kinds = model.jnt_type[model.dof_jntid]
    return kinds == int(mujoco.mjtJoint.mjJNT_FREE)


def _jacobian(
    model: mujoco.MjModel, qpos: np.ndarray, body_id: int, point: np.ndarray
) -> np.ndarray:
    """J [3, nv] of a point of a body, world frame."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    point_w = data.xpos[body_id] + data.xmat[body_id].reshape(3, 3) @ point
    J = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, J, None, point_w, body_id)
    return J


def _gains(
    nv: int, kp: float | np.ndarray | Sequence[float] | None, driven: np.ndarray
) -> np.ndarray:
    """The gains of the driven velocities; those of the others are not looked at."""
    gains = np.asarray(1.0 if kp is None else kp, float)
    if gains.shape not in ((), (nv,)):
        raise ValueError(
            f"kp must be one number or have shape ({nv},), got shape {gains.shape}"
        )
    gains = np.broadcast_to(gains, nv)[driven]
    bad = gains[~(gains > 0.0)]
    if bad.size:
        raise ValueError(f"kp must be positive, got {bad[0]}")
    return gains


def _numbers(name: str, value: np.ndarray | Sequence[float], length: int) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be {length} numbers, got {value!r}") from None
    if array.shape != (length,):
        raise ValueError(f"{name} must have shape ({length},), got {array.shape}")
    bad = array[~np.isfinite(array)]
    if bad.size:
        raise ValueError(f"{name} must be finite, got {bad[0]}")
    return array


def _symmetric(K: np.ndarray) -> np.ndarray:
    K = np.asarray(K, float)
    if K.shape != (3, 3):
        raise ValueError(f"K must have shape (3, 3), got {K.shape}")
    if not all(math.isfinite(entry) for entry in K.flat):
        raise ValueError("K must be finite")
    if np.abs(K - K.T).max() > 1e-6 * np.abs(K).max():
        raise ValueError("K must be symmetric")
    return 0.5 * (K + K.T)
