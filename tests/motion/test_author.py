"""The clips that ship obey mechanics and are what the code makes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcc_jax.character import asset_path, load_character
from dcc_jax.motion import author_door
from dcc_jax.motion.author import RECIPES, author, clip_names
from dcc_jax.motion.author_kinematics import (
    GRAVITY,
    Pose,
    angular_velocity,
    body,
    momentum,
)
from dcc_jax.motion.author_steps import SOLE_RADIUS, sole_spheres
from dcc_jax.motion.clip import load_clip, velocities

FEET = (11, 14)  # bodies
RIGHT_HAND = 8
DT = 1.0 / 30.0
TOUCH = 2e-3  # m
ALL = clip_names()
FLYING = ("jump", "jump_high", "jump_series", "backflip", "run", "run_cycle", "hop")


class Motion:
    """A shipped clip with what mechanics asks of it."""

    def __init__(self, name: str) -> None:
        self.clip = load_clip(asset_path(f"motions/{name}.npz"))
        qpos = self.clip.qpos.astype(float)
        turns = Rotation.from_quat(qpos[:, 3:].reshape(-1, 4), scalar_first=True)
        matrices = turns.as_matrix().reshape(len(qpos), 13, 3, 3)
        self.pose = Pose(qpos[:, :3], matrices[:, 0], matrices[:, 1:])
        self.origins, self.frames = self.pose.frames()
        self.spheres = np.stack(
            [sole_spheres(self.origins[:, f], self.frames[:, f]) for f in FEET], 1
        )
        self.height = self.spheres[..., 2] - SOLE_RADIUS  # [T, 2, 4]
        self.state = momentum(self.pose, DT)

    def flights(self) -> list[slice]:
        """Runs of frames with both soles in the air, without their first and last."""
        air = (self.height.min((1, 2)) > TOUCH).astype(int)
        edges = np.diff(np.concatenate([[0], air, [0]]))
        starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        return [slice(a, b) for a, b in zip(starts, stops, strict=True) if b - a >= 3]


@pytest.fixture(scope="module")
def motions() -> dict[str, Motion]:
    return {name: Motion(name) for name in ALL}


def test_every_recipe_ships():
    folder = asset_path("motions/stand.npz").parent
    assert {path.stem for path in folder.glob("*.npz")} == set(ALL)


def test_the_same_code_gives_the_same_clip():
    made, shipped = (
        author("recover_045"),
        load_clip(asset_path("motions/recover_045.npz")),
    )
    np.testing.assert_array_equal(made.qpos, shipped.qpos)
    assert (made.label, made.loop, made.fps) == ("recover", False, 30.0)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"no clip 'moonwalk'.*backflip"):
        author("moonwalk")


@pytest.mark.parametrize("name", ALL)
def test_soles_neither_sink_nor_slide(motions, name):
    motion = motions[name]
    assert motion.height.min() > -1e-3
    spin = np.stack([angular_velocity(motion.frames[:, f], DT) for f in FEET], 1)
    centre = np.gradient(motion.spheres, DT, axis=0)
    bottom = centre + np.cross(spin, [0.0, 0.0, -SOLE_RADIUS])[:, :, None]
    low = motion.height < TOUCH
    held = low[1:-1] & low[:-2] & low[2:]
    slide = np.linalg.norm(bottom[1:-1, ..., :2], axis=-1)[held]
    assert len(slide) > 10
    assert slide.mean() < 0.03


@pytest.mark.parametrize("name", ALL)
def test_joints_stay_in_their_ranges(motions, name):
    character = load_character()
    quats = motions[name].clip.qpos[:, 7:].reshape(-1, 4)
    angles = Rotation.from_quat(quats, scalar_first=True).as_rotvec()
    angles = angles.reshape(-1, 12, 3)
    outside = np.maximum(angles - character.upper, character.lower - angles)
    assert np.degrees(outside.max()) < 5.0


@pytest.mark.parametrize("name", FLYING)
def test_flight_is_ballistic(motions, name):
    motion = motions[name]
    com, flights = motion.state.com, motion.flights()
    assert flights
    for part in flights:
        fall = np.diff(com[part], n=2, axis=0) / DT**2
        np.testing.assert_allclose(fall[:, 2], -GRAVITY, rtol=0.05)
        assert np.abs(fall[:, :2]).max() < 0.05 * GRAVITY


@pytest.mark.parametrize("name", FLYING)
def test_angular_momentum_is_constant_in_flight(motions, name):
    motion = motions[name]
    for part in motion.flights():
        # Central differences reach into the stance at the first and the last frame.
        spin = motion.state.angular[part][1:-1]
        spread = np.ptp(spin, axis=0).max() if len(spin) else 0.0
        assert spread < 1.0 + 0.1 * np.linalg.norm(spin.mean(0) if len(spin) else 0.0)


@pytest.mark.parametrize("name", [n for n in ALL if n not in FLYING and n != "door"])
def test_ground_reaction_acts_under_the_feet(motions, name):
    motion = motions[name]
    com, spin = motion.state.com, motion.state.angular
    pull = np.gradient(np.gradient(com, DT, axis=0), DT, axis=0)
    force = pull[:, 2] + GRAVITY
    moment = np.gradient(spin, DT, axis=0) / body().mass.sum()
    centre = com[:, :2] - (com[:, 2:] * pull[:, :2]) / force[:, None]
    centre = centre + np.stack([-moment[:, 1], moment[:, 0]], 1) / force[:, None]
    inside = slice(3, -3)
    assert force[inside].min() > 0.3 * GRAVITY
    low = motion.height < 0.01
    corners = np.where(low[..., None], motion.spheres[..., :2], np.nan)
    lowest, highest = (f(corners, axis=(1, 2)) for f in (np.nanmin, np.nanmax))
    outside = np.maximum(lowest - centre, centre - highest)[inside].max(-1)
    assert np.percentile(outside, 95) < 0.03
    assert outside.max() < 0.10


def test_walk_and_run_have_their_speeds(motions):
    for name, speed in (("walk_cycle", 1.2), ("run_cycle", 3.0)):
        qpos = motions[name].clip.qpos
        covered = np.linalg.norm(qpos[-1, :2] - qpos[0, :2])
        assert covered / motions[name].clip.duration == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("name", [n for n, r in RECIPES.items() if r.loop])
def test_loops_close_smoothly(motions, name):
    clip = motions[name].clip
    speed = velocities(clip)
    np.testing.assert_allclose(speed[0, 2:], speed[-1, 2:], atol=1e-3)
    steps = np.abs(np.diff(speed, axis=0))
    assert np.abs(speed[1] - speed[0]).max() < 1.5 * steps.max()


def test_backflip_turns_once_backwards(motions):
    pelvis = motions["backflip"].pose.pelvis
    spin = angular_velocity(pelvis, DT)[:, 1].sum() * DT
    assert spin == pytest.approx(-2.0 * np.pi, abs=0.1)


def test_hop_uses_one_leg(motions):
    low = motions["hop"].height.min(-1) < TOUCH
    hopping = slice(round(2.0 / DT), round(15.0 / DT))
    assert low[hopping, 0].mean() > 0.4
    assert not low[hopping, 1].any()


def test_hand_stays_on_the_knob_of_a_closed_to_open_door(motions):
    motion = motions["door"]
    palm = motion.origins[:, RIGHT_HAND] + np.einsum(
        "tij,j->ti", motion.frames[:, RIGHT_HAND], [0.0, -0.085, 0.0]
    )
    t = np.arange(len(palm)) * DT
    held = (t >= author_door.GRASP_TIME) & (t <= author_door.RELEASE_TIME)
    error = np.linalg.norm(palm - author_door.knob_path(t), axis=-1)
    assert error[held].max() < 2e-3
    arm = palm[held, :2] - author_door.HINGE
    np.testing.assert_allclose(np.linalg.norm(arm, axis=-1), 1.0, atol=2e-3)
    assert np.arctan2(arm[-1, 0], arm[-1, 1]) > 0.7  # the paper's target door angle
    assert motion.clip.duration == pytest.approx(5.0)
    np.testing.assert_allclose(motion.clip.phase, t / 5.0, atol=1e-6)
