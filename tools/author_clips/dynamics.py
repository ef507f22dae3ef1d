"""Whole-body plans that obey Newton: where the centre of mass goes, and its spin.

A plan fixes feet, upper body and the height of the centre of mass. What is left, the
path of the centre of mass on the ground and the rotation of the pelvis in flight, is
found such that the ground reaction acts at the planned centre of pressure and that
nothing acts in flight. Letters: T frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import coo_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import spsolve

from dcc_jax.character import GRAVITY
from tools.author_clips.kinematics import (
    HIPS,
    RIGHT_ELBOW,
    RIGHT_SHOULDER,
    SHIN,
    THIGH,
    Momentum,
    Pose,
    apply,
    body,
    centre_of_mass,
    leg_joints,
    momentum,
    right_arm,
    rotation,
    rotation_vector,
)
from tools.author_clips.steps import FootTrack

RIGHT_ARM = [RIGHT_SHOULDER, RIGHT_ELBOW]
ELBOW_DOWN = np.array([-0.2, -0.5, -1.0])  # where the elbow of a reaching arm points
NEAR = 0.20  # s before and after a flight in which the pelvis may turn ...
LEVER = 0.06  # m, ... for the weight to act no farther than this from the middle
LOWER_TIME = 0.2  # s, over which the body sinks to reach a foothold
EASE = 0.012  # m, over which the reach of a swinging leg fades out
ANKLE_EASE = np.array([0.25, 0.60, 0.25])  # rad, a swinging ankle gives way beyond
SOFT_REACH = 0.990 * (THIGH + SHIN)  # knees bend by 16 degrees at least


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything that is decided by hand about a motion."""

    dt: float  # s
    feet: tuple[FootTrack, FootTrack]  # left, right
    height: np.ndarray  # [T] m, of the centre of mass
    pelvis: np.ndarray  # [T, 3, 3] orientation
    upper: np.ndarray  # [T, 6, 3, 3] spine, neck, shoulders and elbows
    tuck: np.ndarray | None = None  # [T, 2, 3] m, ankles in the pelvis frame ...
    tucked: np.ndarray | None = None  # [T, 2] ... and how far they are drawn there
    palm: np.ndarray | None = None  # [T, 3] m, where the right hand is to be ...
    grasp: np.ndarray | None = None  # [T] ... and how much it is, 0 to 1
    shift: np.ndarray | None = None  # [T, 2] m, added to the centre of pressure
    adapt: bool = True  # lower the body where the legs do not reach
    ends: np.ndarray | None = None  # [2, 2] m, first and last centre of mass

    @property
    def flight(self) -> np.ndarray:
        """[T] whether no foot touches the ground."""
        return ~(self.feet[0].contact | self.feet[1].contact)

    @property
    def pressure(self) -> np.ndarray:
        """Planned centre of pressure [T, 2] in m, from the load on the feet."""
        load = np.stack([foot.load for foot in self.feet], 1)
        load = np.where(load.sum(1, keepdims=True) > 1e-3, load, np.nan)
        place = np.stack([foot.pressure for foot in self.feet], 1)
        path = np.einsum("tf,tfi->ti", load / load.sum(1, keepdims=True), place)
        path = _filled(path)
        return path if self.shift is None else path + self.shift


@dataclass(frozen=True, eq=False)
class Solved:
    """A plan with its whole-body motion."""

    plan: Plan
    pose: Pose
    momentum: Momentum
    distance: np.ndarray  # [T, 2] m, from hips to ankles


def solve(plan: Plan, rounds: int = 12) -> Solved:
    """The motion of a plan: pressure where planned, no external moment in flight."""
    turn = np.zeros((len(plan.height), 3))
    spin_rate = np.zeros_like(turn)
    path = com_path(plan, spin_rate)
    root = np.concatenate([path, plan.height[:, None]], 1)
    solved = place(plan, turn, path, root)
    for _ in range(rounds):
        if plan.flight.any():
            turn = turn + conserving_turn(solved.momentum, plan, turn)
        if plan.adapt:
            plan = replace(plan, height=plan.height - lack_of_reach(solved))
        solved = place(plan, turn, path, solved.pose.root)
        spin = gaussian_filter1d(solved.momentum.angular, 0.02 / plan.dt, axis=0)
        path = com_path(plan, np.gradient(spin, plan.dt, axis=0))
    return place(plan, turn, path, solved.pose.root)


def lack_of_reach(solved: Solved) -> np.ndarray:
    """How much lower [T] (m) the body has to be for standing knees to stay soft.

    The w >= lack of length with the least sum of w^2 + LOWER_TIME^4 w''^2, straight in
    flight, which has to stay ballistic; found by guessing where the bound is active.
    """
    plan = solved.plan
    standing = np.stack([foot.contact for foot in plan.feet], 1)
    need = (standing * np.maximum(solved.distance - SOFT_REACH, 0.0)).max(1)
    frames = len(need)
    stiff = (LOWER_TIME / plan.dt) ** 2 * np.where(plan.flight[1:-1], 100.0, 1.0)
    second = diags_array(stiff) @ _steps(frames - 1) @ _steps(frames)
    system = (second.T @ second + eye_array(frames)).tocsc()
    active, lower = need > 0.0, need
    for _ in range(100):
        bound = diags_array(np.where(active, 1e8, 0.0))
        lower = np.asarray(spsolve((system + bound).tocsc(), bound @ need))
        guess = np.where(active, system @ lower > 0.0, lower < need - 1e-9)
        if (guess == active).all():
            break
        active = guess
    return lower


def com_path(plan: Plan, spin_rate: np.ndarray) -> np.ndarray:
    """Ground path [T, 2] of the centre of mass that puts the pressure where planned.

    Moments about the centre of pressure p balance when, with F = z'' + g,
    F (c - p)_x - z c_x'' = L'_y / m and F (c - p)_y - z c_y'' = -L'_x / m;
    it starts and ends above p or at the plan's `ends`. In flight F = 0: straight and
    uniform.

    Args:
        plan: gives p and z.
        spin_rate: L' [T, 3], kg m^2/s^2.
    """
    dt, height = plan.dt, plan.height
    lift = vertical_force(height, dt)
    target = plan.pressure
    spin = np.stack([spin_rate[:, 1], -spin_rate[:, 0]], 1) / body().mass.sum()
    spin[plan.flight] = 0.0  # the smoothed rate reaches in from the stance
    bands = np.zeros((3, len(height)))
    bands[1] = lift + 2.0 * height / dt**2
    bands[0, 2:] = -height[1:-1] / dt**2
    bands[2, :-2] = -height[1:-1] / dt**2
    right = lift[:, None] * target + spin
    bands[1, [0, -1]] = 1.0
    right[[0, -1]] = target[[0, -1]] if plan.ends is None else plan.ends
    return solve_banded((1, 1), bands, right)


def vertical_force(height: np.ndarray, dt: float) -> np.ndarray:
    """Ground reaction over mass [T], z'' + g, never pulling."""
    second = np.zeros_like(height)
    second[1:-1] = (height[2:] - 2.0 * height[1:-1] + height[:-2]) / dt**2
    return np.maximum(second + GRAVITY, 0.0)


def place(plan: Plan, turn: np.ndarray, path: np.ndarray, root: np.ndarray) -> Solved:
    """The poses with the centre of mass on `path` and the pelvis turned by `turn`.

    The root is found by moving it by the error of the centre of mass, again and again:
    the legs' share of the mass makes each round about 6 times better.
    """
    pelvis = rotation(turn) @ plan.pelvis
    target = np.concatenate([path, plan.height[:, None]], 1)
    for _ in range(4):
        pose, distance = _posed(plan, pelvis, root)
        root = root + target - centre_of_mass(pose)
    pose, distance = _posed(plan, pelvis, root)
    return Solved(plan, pose, momentum(pose, plan.dt), distance)


def _posed(plan: Plan, pelvis: np.ndarray, root: np.ndarray) -> tuple[Pose, np.ndarray]:
    ankles = np.stack([foot.ankle for foot in plan.feet], 1)
    feet = np.stack([foot.rotation for foot in plan.feet], 1)
    if plan.tuck is not None and plan.tucked is not None:
        drawn = root[:, None] + apply(pelvis[:, None], plan.tuck)
        ankles = ankles + plan.tucked[..., None] * (drawn - ankles)
        feet = _blend(feet, pelvis[:, None], plan.tucked)
    ankles = _drawn_in(ankles, root[:, None] + apply(pelvis[:, None], HIPS), plan)
    forward = pelvis[:, None, :, 0] + 0.5 * _foot_headings(plan)
    legs, distance = leg_joints(root, pelvis, ankles, feet, forward)
    for ankle, foot in zip((2, 5), plan.feet, strict=True):
        legs[:, ankle] = _relaxed(legs[:, ankle], foot.contact, plan.dt)
    pose = Pose(root, pelvis, np.concatenate([plan.upper, legs], 1))
    if plan.palm is not None and plan.grasp is not None:
        hanging = pose.joints[:, RIGHT_ARM]
        reaching = right_arm(pose, plan.palm, ELBOW_DOWN[None])
        share = np.stack([plan.grasp, plan.grasp], 1)
        pose.joints[:, RIGHT_ARM] = _blend(hanging, reaching, share)
    return pose, distance


def _drawn_in(ankles: np.ndarray, hips: np.ndarray, plan: Plan) -> np.ndarray:
    """Ankles [T, 2, 3] with those of swinging feet softly kept within reach."""
    away = ankles - hips
    distance = np.linalg.norm(away, axis=-1)
    within = SOFT_REACH - EASE * np.logaddexp(0.0, (SOFT_REACH - distance) / EASE)
    share = np.stack([_freedom(foot.contact, plan.dt, 0.06) for foot in plan.feet], 1)
    scale = 1.0 + share * (np.minimum(within / distance, 1.0) - 1.0)
    return hips + scale[..., None] * away


def _freedom(contact: np.ndarray, dt: float, ease: float) -> np.ndarray:
    """[T] 0 on the ground, 1 when the foot is more than `ease` s away from it."""
    frames = np.asarray(distance_transform_edt(~contact))
    return np.minimum(frames * dt / ease, 1.0)


def _foot_headings(plan: Plan) -> np.ndarray:
    """Where the feet point on the ground [T, 2, 3], unless they are drawn up."""
    yaw = np.stack([foot.yaw for foot in plan.feet], 1)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], -1)
    return heading if plan.tucked is None else heading * (1.0 - plan.tucked[..., None])


def _relaxed(ankle: np.ndarray, contact: np.ndarray, dt: float) -> np.ndarray:
    """Ankle rotations [T, 3, 3] kept in their range while the foot swings."""
    vector = rotation_vector(ankle)
    beyond = np.abs(vector) - ANKLE_EASE
    eased = np.sign(vector) * (
        ANKLE_EASE + 0.2 * np.tanh(np.maximum(beyond, 0.0) / 0.2)
    )
    share = _freedom(contact, dt, 0.08)[:, None] * (beyond > 0.0)
    return rotation(vector + share * (eased - vector))


def _blend(begin: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    step = rotation_vector(begin.swapaxes(-1, -2) @ np.broadcast_to(end, begin.shape))
    return begin @ rotation(share[..., None] * step)


def conserving_turn(state: Momentum, plan: Plan, turn: np.ndarray) -> np.ndarray:
    """Small rotation [T, 3] of the pelvis that leaves no more moment than there can be.

    Least squares: the rate of L + I turn' is zero in flight and, close to a flight,
    small against the weight carried times `LEVER`; the turn is small and smooth.
    """
    frames, dt = len(plan.height), plan.dt
    away = np.asarray(distance_transform_edt(~plan.flight)) * dt
    close = away < NEAR
    rate = kron(_steps(frames) / dt, eye_array(3))
    middle = 0.5 * (state.inertia[1:] + state.inertia[:-1])
    blocks = _block_diagonal(middle) @ rate
    inner = np.flatnonzero(close[1:-1]) + 1
    before = (3 * (inner - 1)[:, None] + np.arange(3)).ravel()
    spin = 0.5 * (state.angular[1:] + state.angular[:-1]).ravel()
    force = body().mass.sum() * vertical_force(plan.height, dt)[inner]
    weight = np.repeat((1.0 - away[inner] / NEAR) / (0.2 + LEVER * force), 3)
    hold = diags_array(weight) @ (blocks[before + 3] - blocks[before]) / dt
    want = -weight * (spin[before + 3] - spin[before]) / dt
    second = kron(_steps(frames - 1) @ _steps(frames) / dt**2, eye_array(3))
    keep = np.interp(away, [0.0, NEAR], [10.0, 30.0])
    system = vstack([hold, 0.02 * second, diags_array(np.repeat(keep, 3))]).tocsr()
    back = -(np.where(plan.flight, 0.0, keep)[:, None] * turn).ravel()
    right = np.concatenate([want, np.zeros(3 * frames - 6), back])
    answer = np.asarray(spsolve((system.T @ system).tocsc(), system.T @ right))
    return answer.reshape(frames, 3)


def _steps(frames: int):
    """Sparse matrix [T - 1, T] that takes each frame from the next."""
    return eye_array(frames - 1, frames, k=1) - eye_array(frames - 1, frames)


def _block_diagonal(blocks: np.ndarray):
    count = len(blocks)
    index = np.arange(3 * count).reshape(count, 3)
    rows = np.repeat(index, 3, axis=1).ravel()
    columns = np.tile(index, (1, 3)).ravel()
    return coo_array((blocks.ravel(), (rows, columns))).tocsr()


def _filled(path: np.ndarray) -> np.ndarray:
    """NaN rows replaced by linear interpolation over time."""
    known = ~np.isnan(path[:, 0])
    frame = np.arange(len(path))
    columns = [np.interp(frame, frame[known], path[known, k]) for k in range(2)]
    return np.stack(columns, 1)


def cropped(solved: Solved, start: int, stop: int) -> Solved:
    """Frames `start` to `stop` (exclusive) of the poses and momenta."""
    part = slice(start, stop)
    pose = Pose(
        solved.pose.root[part], solved.pose.pelvis[part], solved.pose.joints[part]
    )
    state = solved.momentum
    moments = Momentum(state.com[part], state.angular[part], state.inertia[part])
    return replace(solved, pose=pose, momentum=moments, distance=solved.distance[part])
