"""Where the feet go: footholds, rolling soles, swings between them, and foot load.

Letters: T times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.author_clips.kinematics import ANKLE_HEIGHT, about, apply

TOE, HEEL = 0.15, -0.04  # m ahead of the ankle: the sole spheres of character.xml
SOLE_RADIUS = 0.02
SOLE_DROP = ANKLE_HEIGHT - SOLE_RADIUS  # ankle to the centres of the sole spheres
SOLE_WIDTH = 0.03
STAND_AHEAD = 0.04  # m, centre of pressure of a stand ahead of the ankles
DRIVE = 5.0  # acceleration a swing starts with, over distance / duration^2
_EPS = 1e-4


def smoothstep(s: np.ndarray) -> np.ndarray:
    """0 before 0, 1 after 1, three derivatives zero at both ends."""
    s = np.clip(s, 0.0, 1.0)
    return s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)


def ramp(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """`smoothstep` from 0 at `start` to 1 at `stop` (s)."""
    return smoothstep((t - start) / max(stop - start, 1e-9))


def brisk(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """As `ramp`, but at once under way: only the rate is zero at both ends."""
    s = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return s**2 * (3.0 - 2.0 * s)


def quintic(
    s: np.ndarray,
    span: float,
    begin: tuple[np.ndarray | float, ...],
    end: tuple[np.ndarray | float, ...],
) -> np.ndarray:
    """Quintic between two (value, rate, acceleration); s in [0, 1] spans `span` s."""
    p0, v0, a0 = (np.asarray(x, float) * span**k for k, x in enumerate(begin))
    p1, v1, a1 = (np.asarray(x, float) * span**k for k, x in enumerate(end))
    s = np.asarray(s)[(...,) + (None,) * p0.ndim]
    gap = p1 - p0 - v0 - a0 / 2.0
    rate, bend = v1 - v0 - a0, a1 - a0
    c3 = 10.0 * gap - 4.0 * rate + bend / 2.0
    c4 = -15.0 * gap + 7.0 * rate - bend
    c5 = 6.0 * gap - 3.0 * rate + bend / 2.0
    return p0 + s * (v0 + s * (a0 / 2.0 + s * (c3 + s * (c4 + s * c5))))


@dataclass(frozen=True)
class Foothold:
    """One foot on the ground from `land` to `lift` (s).

    `strike` and `push` are the pitch of the foot (rad, toes down positive) when it
    lands and when it lifts; in between it rolls flat over heel or toes. The rest
    describes the swing that follows.
    """

    x: float  # m, of the ankle of the flat foot
    y: float
    yaw: float  # rad
    land: float = -1e3
    lift: float = 1e3
    strike: float = 0.0
    push: float = 0.0
    flatten: float = 0.10  # s, from `strike` to flat
    peel: float = 0.20  # s, from flat to `push`
    take: float = 0.15  # s, to take up load after landing
    shed: float = 0.15  # s, to give it away before lifting
    clearance: float = 0.05  # m, height of the swing that follows
    early: float = 0.5  # when in the swing it is highest
    curl: float = 0.0  # rad, more pitch in mid-swing
    lag: float = 0.0  # share of the way by which it hangs back in mid-swing
    snap: float = 2.0  # least power of the rise: below 2 it leaves the ground quickly

    def pitch(self, t: np.ndarray) -> np.ndarray:
        """Pitch [T] in rad while on the ground."""
        down = np.clip((t - self.land) / self.flatten, 0.0, 1.0)
        up = np.clip((t - self.lift + self.peel) / self.peel, 0.0, 1.0)
        return self.strike * (1.0 - down) ** 2 * (1.0 + 2.0 * down) + (
            self.push * up**2 * (0.4 + 0.6 * up)
        )

    def ankle(self, pitch: np.ndarray) -> np.ndarray:
        """Position [T, 3] of the ankle when the sole rolls to `pitch` without slip."""
        pivot = np.where(pitch > 0.0, TOE, HEEL)[:, None] * [1.0, 0.0, 0.0]
        pivot = pivot - [0.0, 0.0, SOLE_DROP]
        moved = pivot - apply(about("y", pitch), pivot)
        moved[:, 0] += SOLE_RADIUS * pitch
        flat = np.array([self.x, self.y, ANKLE_HEIGHT])
        return flat + apply(about("z", self.yaw), moved)

    def load(self, t: np.ndarray) -> np.ndarray:
        """Share of the weight [T] this foot is willing to take, 0 to 1."""
        return ramp(t, self.land, self.land + self.take) * (
            1.0 - ramp(t, self.lift - self.shed, self.lift)
        )

    def touches(self, t: np.ndarray) -> np.ndarray:
        """[T] whether the foot is on the ground."""
        return (t >= self.land) & (t <= self.lift)


@dataclass(frozen=True, eq=False)
class FootTrack:
    """One foot over time."""

    ankle: np.ndarray  # [T, 3] m
    rotation: np.ndarray  # [T, 3, 3]
    yaw: np.ndarray  # [T] rad
    contact: np.ndarray  # [T] bool
    load: np.ndarray  # [T] 0 to 1
    pressure: np.ndarray  # [T, 2] m, where the foot presses on the ground


def foot_track(
    t: np.ndarray,
    holds: list[Foothold],
    pressure: tuple[float, float] = (0.04, 0.04),
) -> FootTrack:
    """The foot through its footholds, swinging between them.

    Args:
        t: times [T] in s.
        holds: footholds in order; the first and the last may reach past the clip.
        pressure: centre of pressure ahead of the ankle when a stance begins and when
            it ends, m.
    """
    ankle, pitch, yaw = np.zeros((len(t), 3)), np.zeros(len(t)), np.zeros(len(t))
    load, centre = np.zeros(len(t)), np.zeros((len(t), 2))
    contact = np.zeros(len(t), bool)
    for index, hold in enumerate(holds):
        on = hold.touches(t)
        contact |= on
        pitch[on], yaw[on] = hold.pitch(t[on]), hold.yaw
        ankle[on] = hold.ankle(pitch[on])
        load[on] = hold.load(t[on])
        ahead = _pressure_ahead(t, hold, pressure)
        heading = np.array([np.cos(hold.yaw), np.sin(hold.yaw)])
        until = holds[index + 1].land if index + 1 < len(holds) else np.inf
        own = (t >= (hold.land if index else -np.inf)) & (t < until)
        centre[own] = [hold.x, hold.y] + ahead[own, None] * heading
        if index + 1 < len(holds):
            air = (t > hold.lift) & (t < holds[index + 1].land)
            ankle[air], pitch[air], yaw[air] = swing(t[air], hold, holds[index + 1])
    rotation = about("z", yaw) @ about("y", pitch)
    ankle[:, 2] += np.maximum(-sole_height(ankle, rotation), 0.0)
    return FootTrack(ankle, rotation, yaw, contact, load, centre)


def _pressure_ahead(
    t: np.ndarray, hold: Foothold, pressure: tuple[float, float]
) -> np.ndarray:
    """Centre of pressure [T] ahead of the ankle; a stand keeps it at `STAND_AHEAD`."""
    begin = pressure[0] if hold.land > 0.0 else STAND_AHEAD
    end = pressure[1] if hold.lift < t[-1] else STAND_AHEAD
    start = hold.land if hold.land > 0.0 else hold.lift - 0.7
    stop = hold.lift if hold.lift < t[-1] else hold.land + 0.7
    margin = 0.1 * (stop - start)
    return begin + (end - begin) * ramp(t, start + margin, stop - margin)


def swing(
    t: np.ndarray, begin: Foothold, end: Foothold
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ankle [T, 3], pitch and yaw [T] between two footholds, velocities continuous."""
    span = end.land - begin.lift
    s = (t - begin.lift) / span
    out = np.array([begin.lift - _EPS, begin.lift])
    into = np.array([end.land, end.land + _EPS])
    out_pitch, in_pitch = begin.pitch(out), end.pitch(into)
    out_ankle, in_ankle = begin.ankle(out_pitch), end.ankle(in_pitch)
    pitch = quintic(
        s,
        span,
        (out_pitch[1], np.diff(out_pitch)[0] / _EPS, 0.0),
        (in_pitch[0], np.diff(in_pitch)[0] / _EPS, 0.0),
    )
    way = (in_ankle[0] - out_ankle[1]) * [1.0, 1.0, 0.0]
    drive = DRIVE * way / span**2
    ankle = quintic(
        s,
        span,
        (out_ankle[1], (out_ankle[1] - out_ankle[0]) / _EPS, drive),
        (in_ankle[0], (in_ankle[1] - in_ankle[0]) / _EPS, -drive),
    )
    ankle -= begin.lag * bump(s)[:, None] * way
    ankle[:, 2] += begin.clearance * bump(s, begin.early, begin.snap)
    pitch = pitch + begin.curl * bump(s, begin.early)
    return ankle, pitch, begin.yaw + (end.yaw - begin.yaw) * smoothstep(s)


def bump(s: np.ndarray, peak: float = 0.5, power: float = 2.0) -> np.ndarray:
    """0 at both ends, 1 at `peak`; it starts and ends at least as s^power."""
    s = np.clip(s, 0.0, 1.0)
    ratio = (1.0 - peak) / peak
    a, b = power * max(1.0, 1.0 / ratio), power * max(1.0, ratio)
    return (s / peak) ** a * ((1.0 - s) / (1.0 - peak)) ** b


def sole_spheres(ankle: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Centres [..., 4, 3] of the sole spheres of a foot [..., 3], [..., 3, 3]."""
    local = np.array(
        [[x, y, -SOLE_DROP] for x in (HEEL, TOE) for y in (-SOLE_WIDTH, SOLE_WIDTH)]
    )
    return ankle[..., None, :] + apply(rotation[..., None, :, :], local)


def sole_height(ankle: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Height [...] of the lowest point of the sole above the ground, m."""
    return sole_spheres(ankle, rotation)[..., 2].min(-1) - SOLE_RADIUS
