"""The clips that ship obey mechanics and are what the code makes."""

import numpy as np
import pytest
from inverse import effort
from scipy.spatial.transform import Rotation

from dcc_jax.character import GRAVITY, asset_path, load_character
from dcc_jax.motion.clip import load_clip, save_clip, velocities
from tools.author_clips import door
from tools.author_clips.kinematics import Pose, angular_velocity, momentum
from tools.author_clips.recipes import RECIPES, author, clip_names
from tools.author_clips.steps import SOLE_RADIUS, sole_spheres

FEET = (11, 14)  # bodies
RIGHT_HAND = 8
DT = 1.0 / 30.0
TOUCH = 2e-3  # m
ALL = clip_names()
GROUNDED = ("stand", "recover", "balance", "walk", "door")
FLYING = tuple(name for name in ALL if not name.startswith(GROUNDED))


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


@pytest.mark.parametrize("name", ["recover_045", "run_cycle"])
def test_the_same_code_gives_the_same_bytes(tmp_path, name):
    made = author(name)
    save_clip(tmp_path / "again.npz", made)
    shipped = asset_path(f"motions/{name}.npz")
    assert (tmp_path / "again.npz").read_bytes() == shipped.read_bytes()
    assert not np.signbit(made.qpos[made.qpos == 0.0]).any()


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


@pytest.mark.parametrize("name", [n for n in FLYING if n != "jog_cycle"])
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


@pytest.mark.parametrize("name", ALL)
def test_muscles_and_soles_could_have_made_the_motion(motions, name):
    """Forces in the friction cones under the soles move the root as it moves.

    At 30 frames a second the frames next to a flight mix contact and flight, and a
    backflip is at the limits of the body.
    """
    force, moment, torque, speed = 0.01, 1.0, 0.5, 10.0
    if name.startswith("walk") or name == "door":
        force, moment, torque = 0.15, 12.0, 0.7
    if name in FLYING:
        force, moment, torque, speed = 0.40, 60.0, 1.1, 22.0
    if name == "backflip":
        force, moment, torque, speed = 0.60, 150.0, 1.8, 28.0
    needs = effort(motions[name].clip)
    assert needs.force.max() < force
    assert needs.moment.max() < moment
    assert needs.torque.max() < torque
    assert needs.speed < speed
    assert np.median(needs.force) < 0.05
    assert np.median(needs.moment) < 4.0


STRIDES = [n for n in ALL if n.endswith("_cycle") and not n.startswith("hop")]


@pytest.mark.parametrize("name", STRIDES)
def test_legs_stretch_in_every_step(motions, name):
    """Nobody walks or runs in a crouch."""
    motion = motions[name]
    knee = Rotation.from_matrix(motion.pose.joints[:, 7]).as_rotvec()[:, 1]
    stands = motion.height[:, 0].min(1) < TOUCH
    hip = motion.origins[:, 9] - motion.origins[:, 11]
    behind = np.degrees(np.arctan2(hip[:, 0], hip[:, 2]))[stands].max()
    assert np.degrees(knee[stands].min()) < 32.0
    assert np.degrees(knee[stands].max()) < 65.0
    assert np.degrees(knee.max()) > 55.0  # the swinging leg is drawn up
    assert behind > 18.0  # degrees, the leg from vertical when it leaves the ground


@pytest.mark.parametrize("name", [n for n in ALL if n.endswith("_cycle")])
def test_the_pelvis_goes_evenly(motions, name):
    """Less than recorded people do: legs that swing too early drag it to and fro."""
    speed = np.linalg.norm(velocities(motions[name].clip)[:, :2], axis=1)
    assert speed.std() < 0.27


@pytest.mark.parametrize(
    ("name", "speed"),
    [
        ("walk_slow_cycle", 0.8),
        ("walk_cycle", 1.2),
        ("walk_fast_cycle", 1.6),
        ("jog_cycle", 2.0),
        ("run_cycle", 3.0),
    ],
)
def test_gaits_have_their_speeds(motions, name, speed):
    clip = motions[name].clip
    covered = np.linalg.norm(clip.qpos[-1, :2] - clip.qpos[0, :2])
    assert covered / clip.duration == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("gait", ["walk", "jog", "run"])
def test_gaits_turn_left_and_right_alike(motions, gait):
    def turn(name: str) -> float:
        return np.unwrap(
            Rotation.from_matrix(motions[name].pose.pelvis).as_euler("ZYX")[:, 0]
        )[-1]

    assert turn(f"{gait}_left") > 0.9
    assert turn(f"{gait}_right") == pytest.approx(-turn(f"{gait}_left"), abs=0.05)
    assert turn(gait) == pytest.approx(0.0, abs=0.01)


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


def test_hop_uses_one_leg_and_goes_everywhere(motions):
    motion = motions["hop"]
    low = motion.height.min(-1) < TOUCH
    hopping = slice(round(2.0 / DT), round(14.5 / DT))
    assert low[hopping, 0].mean() > 0.4
    assert not low[hopping, 1].any()
    flights = [motion.state.com[part, :2] for part in motion.flights()]
    hops = np.array([path[-1] - path[0] for path in flights])
    eighth = np.round(np.arctan2(hops[:, 1], hops[:, 0]) / (np.pi / 4)).astype(int) % 8
    assert set(eighth) == set(range(8))
    assert (eighth[1:] == eighth[:-1]).sum() > 10  # several in a row


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("hop_cycle", (0.0, 0.0)),
        ("hop_ahead_cycle", (0.2, 0.0)),
        ("hop_left_cycle", (0.0, 0.2)),
    ],
)
def test_cycles_of_hops_land_where_they_should(motions, name, way):
    motion = motions[name]
    whole = [path for path in motion.flights() if path.start > 0]
    flights = [motion.state.com[part, :2] for part in whole]
    assert len(flights) >= 4
    for path in flights:
        share = 0.2 / 0.48  # of a hop, in the air
        np.testing.assert_allclose(
            path[-1] - path[0], np.multiply(way, share), atol=0.03
        )


def test_hand_stays_on_the_knob_of_a_closed_to_open_door(motions):
    motion = motions["door"]
    palm = motion.origins[:, RIGHT_HAND] + np.einsum(
        "tij,j->ti", motion.frames[:, RIGHT_HAND], [0.0, -0.085, 0.0]
    )
    t = np.arange(len(palm)) * DT
    held = (t >= door.GRASP_TIME) & (t <= door.RELEASE_TIME)
    error = np.linalg.norm(palm - door.knob_path(t), axis=-1)
    assert error[held].max() < 2e-3
    arm = palm[held, :2] - door.HINGE
    np.testing.assert_allclose(np.linalg.norm(arm, axis=-1), 1.0, atol=2e-3)
    assert np.arctan2(arm[-1, 0], arm[-1, 1]) > 0.7  # the paper's target door angle
    assert motion.clip.duration == pytest.approx(5.0)
    np.testing.assert_allclose(motion.clip.phase, t / 5.0, atol=1e-6)
