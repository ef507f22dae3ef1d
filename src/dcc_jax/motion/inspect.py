"""A page of figures and a video of a clip.

Letters: T frames, 12 joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from dcc_jax.character import FEET, Character, compose_scene, load_character
from dcc_jax.motion.clip import Clip, velocities
from dcc_jax.viz import draw, files

CONTACT_HEIGHT = 0.02  # m, a sole lower than this touches ...
CONTACT_SPEED = 0.4  # m/s, ... when it is also slower than this
STRIP_POSES = 9
STRIP_VIEW = draw.View(azimuth=110.0, elevation=-8.0, distance=2.9, smooth=1e-3)
COLOURS = ("#1f6fb4", "#c8553d", "#3a7d44")  # x, y, z; the feet are the first two
LABELS = ("x", "y", "z")


def plot(clip: Clip, path: str | Path, *, fallback: bool | None = None) -> None:
    """One page: posed bodies, path, speed, feet and contacts, joint angles and ranges.

    Args:
        clip: what to show.
        path: picture to write; its ending says the format.
        fallback: see `draw.frames`.

    Raises:
        ValueError: the ending of `path` is no picture format.
    """
    page = Figure(figsize=(15, 13), layout="constrained")
    canvas = FigureCanvasAgg(page)
    ending = Path(path).suffix.lstrip(".").lower()
    if ending not in canvas.get_supported_filetypes():
        known = ", ".join(sorted(canvas.get_supported_filetypes()))
        raise ValueError(f"cannot write {ending!r} pictures, only {known}")
    character = load_character()
    rows = page.add_gridspec(5, 4, height_ratios=[1.5, 1.2, 1, 1, 1])
    _plot_strip(page.add_subplot(rows[0, :]), clip, fallback)
    _plot_path(page.add_subplot(rows[1, 0]), clip)
    _plot_speed(page.add_subplot(rows[1, 1]), clip)
    _plot_feet(page.add_subplot(rows[1, 2:]), clip, character)
    angles = joint_angles(clip)
    for joint, name in enumerate(character.joint_names):
        axes = page.add_subplot(rows[2 + joint // 4, joint % 4])
        limits = character.lower[joint], character.upper[joint]
        _plot_joint(axes, clip, name, angles[:, joint], *limits)
    page.suptitle(_title(clip, angles, character))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    page.savefig(path, dpi=80)


def video(clip: Clip, path: str | Path, *, fallback: bool | None = None) -> None:
    """Writes the clip as an mp4 that follows the character.

    Raises:
        ModuleNotFoundError: the `video` extra is not installed.
    """
    files.write_mp4(path, pictures(clip, fallback=fallback), clip.fps)


def pictures(
    clip: Clip,
    *,
    size: tuple[int, int] = (640, 480),
    view: draw.View | None = None,
    fallback: bool | None = None,
) -> Iterator[np.ndarray]:
    """The clip's frames as images [height, width, 3] uint8."""
    model = compose_scene(load_character())
    return draw.frames(model, clip.qpos, camera=view, size=size, fallback=fallback)


def joint_angles(clip: Clip) -> np.ndarray:
    """Rotation vectors [T, 12, 3] of the joints in rad, as the ranges bound them."""
    quats = clip.qpos[:, 7:].reshape(-1, 4)
    vectors = Rotation.from_quat(quats, scalar_first=True).as_rotvec()
    return vectors.reshape(len(clip.qpos), -1, 3)


def outside_ranges(angles: np.ndarray, character: Character) -> np.ndarray:
    """How far [T, 12, 3] rotation vectors lie outside the joint ranges, rad."""
    above = np.maximum(angles - character.upper, 0.0)
    return above + np.maximum(character.lower - angles, 0.0)


def sole_heights(clip: Clip, character: Character) -> tuple[np.ndarray, np.ndarray]:
    """Heights [T, 2] of the soles' lowest points and which soles touch the ground.

    A sole touches where one of its spheres is low and slow.
    """
    model = compose_scene(character)
    data = mujoco.MjData(model)
    soles = [[_geom(model, i) for i in _soles(model, foot)] for foot in FEET]
    points = np.zeros((len(clip.qpos), 2, 4, 3))
    for frame, q in enumerate(clip.qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        points[frame] = data.geom_xpos[np.array(soles)]
    radius = model.geom_size[soles[0][0], 0]
    speed = np.linalg.norm(np.gradient(points, 1.0 / clip.fps, axis=0), axis=-1)
    height = points[..., 2] - radius
    touching = (height < CONTACT_HEIGHT) & (speed < CONTACT_SPEED)
    return height.min(-1), touching.any(-1)


def _soles(model: mujoco.MjModel, foot: str) -> list[str]:
    names = [model.geom(i).name for i in range(model.ngeom)]
    return [name for name in names if name.startswith(f"{foot.split('_')[0]}_sole_")]


def _geom(model: mujoco.MjModel, name: str) -> int:
    return int(model.geom(name).id)


def _times(clip: Clip) -> np.ndarray:
    return np.arange(len(clip.qpos)) / clip.fps


def _title(clip: Clip, angles: np.ndarray, character: Character) -> str:
    outside = np.degrees(outside_ranges(angles, character).max())
    parts = [
        clip.name,
        f"{clip.duration:.2f} s at {clip.fps:g} fps",
        "loop" if clip.loop else "",
        f"label {clip.label}" if clip.label else "",
        f"largest joint-range violation {outside:.0f} deg",
        clip.source,
    ]
    return "   ".join(part for part in parts if part)


def _plot_strip(axes: Axes, clip: Clip, fallback: bool | None) -> None:
    chosen = np.linspace(0, len(clip.qpos) - 1, STRIP_POSES).round().astype(int)
    model = compose_scene(load_character())
    images = draw.frames(
        model, clip.qpos[chosen], camera=STRIP_VIEW, size=(200, 300), fallback=fallback
    )
    strip = np.concatenate(list(images), axis=1)
    axes.imshow(strip, aspect="equal")
    axes.set_xticks(
        (np.arange(STRIP_POSES) + 0.5) * strip.shape[1] / STRIP_POSES,
        [f"{frame / clip.fps:.2f} s" for frame in chosen],
    )
    axes.set_yticks([])


def _plot_path(axes: Axes, clip: Clip) -> None:
    x, y = clip.qpos[:, 0], clip.qpos[:, 1]
    axes.plot(-y, x, color=COLOURS[0])
    axes.plot(-y[0], x[0], "o", color=COLOURS[2], label="start")
    axes.plot(-y[-1], x[-1], "s", color=COLOURS[1], label="end")
    axes.set(title="root from above (x up, y left)", xlabel="-y (m)", ylabel="x (m)")
    axes.axis("equal")
    axes.legend(fontsize=7, loc="upper right")


def _plot_speed(axes: Axes, clip: Clip) -> None:
    velocity = velocities(clip)[:, :3]
    t = _times(clip)
    axes.plot(t, np.linalg.norm(velocity[:, :2], axis=1), label="ground speed")
    axes.plot(t, velocity[:, 2], label="vertical", lw=0.8)
    axes.set(title="speed of the root", xlabel="s", ylabel="m/s")
    axes.legend(fontsize=7, loc="upper right")


def _plot_feet(axes: Axes, clip: Clip, character: Character) -> None:
    height, touching = sole_heights(clip, character)
    t = _times(clip)
    for side, foot in enumerate(FEET):
        axes.plot(t, 100.0 * height[:, side], color=COLOURS[side], label=foot)
        base = -2.0 - 1.5 * side
        spans = [(x, 1.0 / clip.fps) for x in t[touching[:, side]]]
        axes.broken_barh(spans, (base, 1.2), color=COLOURS[side])
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set(title="height of the soles, bars: contact", xlabel="s", ylabel="cm")
    axes.legend(fontsize=7, loc="upper right")


def _plot_joint(
    axes: Axes,
    clip: Clip,
    name: str,
    angles: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> None:
    t = _times(clip)
    for axis, colour in enumerate(COLOURS):
        low, high = np.degrees([lower[axis], upper[axis]])
        axes.plot(t, np.degrees(angles[:, axis]), color=colour, label=LABELS[axis])
        for limit in (low, high):
            axes.axhline(limit, color=colour, lw=0.7, ls=":")
    axes.set_title(f"{name} (deg, dotted: range)", fontsize=9)
    axes.tick_params(labelsize=7)
    if name == "spine":
        axes.legend(fontsize=7, ncols=3, loc="upper right")
