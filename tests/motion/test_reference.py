"""q_m(t), Reference State Initialization and expert windows."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcc_jax.motion.clip import Clip
from dcc_jax.motion.reference import make_references, planar_moved

FPS = 30.0
DT = 1.0 / FPS

qpos_at = jax.jit(lambda refs, clip, time: refs.qpos_at(clip, time))
qvel_at = jax.jit(lambda refs, clip, time: refs.qvel_at(clip, time))
SPANS = np.tile([1, 3], 2000 // 2)  # of the windows, in control steps


def still(frames: int) -> np.ndarray:
    qpos = np.zeros((frames, 55), np.float32)
    qpos[:, 2] = 0.9
    qpos[:, 3::4] = 1.0
    return qpos


def circle(duration: float = 1.0, rate: float = 1.3, **changes) -> Clip:
    """Walking round a circle of radius 2 m, the spine nodding once a period."""
    return Clip(
        circle_qpos(np.arange(round(duration * FPS) + 1) / FPS, duration, rate),
        FPS,
        "circle",
        loop=True,
        **changes,
    )


def circle_qpos(t: np.ndarray, duration: float = 1.0, rate: float = 1.3) -> np.ndarray:
    qpos = still(len(t))
    qpos[:, 0], qpos[:, 1] = 2.0 * np.sin(rate * t), 2.0 - 2.0 * np.cos(rate * t)
    qpos[:, 3], qpos[:, 6] = np.cos(0.5 * rate * t), np.sin(0.5 * rate * t)
    nod = 0.3 * np.sin(2 * np.pi * t / duration)
    qpos[:, 7], qpos[:, 9] = np.cos(0.5 * nod), np.sin(0.5 * nod)
    return qpos


def line(start: float, seconds: float, name: str = "line", **changes) -> Clip:
    """Uniform motion at 1 m/s along x from `start`."""
    qpos = still(round(seconds * FPS) + 1)
    qpos[:, 0] = start + np.arange(len(qpos)) / FPS
    return Clip(qpos, FPS, name, **changes)


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    dots = np.abs(np.sum(a.reshape(-1, 4) * b.reshape(-1, 4), -1))
    return 2.0 * np.arccos(np.clip(dots, 0.0, 1.0))


@pytest.fixture(scope="module")
def refs():
    """0: a line, 1: a circle, 2: a short line far away, 3: one that is never drawn."""
    half = np.linspace(0.5, 1.0, 5, dtype=np.float32)
    return make_references(
        [
            line(0.0, 1.0),
            circle(),
            line(50.0, 4 * DT, phase=half),
            line(90.0, 1.0),
        ],
        weights=[3.0, 2.0, 1.0, 0.0],
    )


@pytest.fixture(scope="module")
def windows(refs):
    """Two draws of windows by one compiled function."""
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def draw(references, key):
        return references.sample_windows(key, SPANS)[0]

    return [np.array(draw(refs, jax.random.key(seed))) for seed in (0, 1)]


@pytest.fixture(scope="module")
def states(refs):
    """The same initial states as they are, and turned and moved at random."""
    keys = jax.random.split(jax.random.key(4), 100)
    plain = jax.jit(jax.vmap(refs.sample))(keys)
    again = jax.random.clone(keys)
    moved = jax.jit(jax.vmap(partial(refs.sample, heading=True, radius=3.0)))(again)
    return jax.tree.map(np.array, (plain, moved))


def test_a_loop_goes_on_along_its_circle(refs):
    times = np.array([0.4, 1.0, 2.7, 7.31, -1.6])
    poses = np.array([qpos_at(refs, 1, t) for t in times])
    expected = circle_qpos(times)
    # Chords of 43 mrad deviate from the circle by 2 (1 - cos(0.022)) m.
    np.testing.assert_allclose(poses[:, :3], expected[:, :3], atol=1e-3)
    assert angles_between(poses[:, 3:], expected[:, 3:]).max() < 2e-3


def test_a_loop_is_continuous_across_its_seam(refs):
    before, after = (np.array(qpos_at(refs, 1, 1.0 + d)) for d in (-1e-4, 1e-4))
    np.testing.assert_allclose(before[:3], after[:3], atol=1e-3)
    before, after = (np.array(qvel_at(refs, 1, 1.0 + d)) for d in (-1e-4, 1e-4))
    np.testing.assert_allclose(before, after, atol=2e-2)


@pytest.mark.parametrize("time", [0.5, 0.99, 1.02, 3.6])
def test_velocity_is_the_rate_of_the_pose(refs, time):
    before, after = (
        np.array(qpos_at(refs, 1, time + sign * 0.5 * DT)) for sign in (-1, 1)
    )
    first, second = (
        Rotation.from_quat(q[3:].reshape(-1, 4), scalar_first=True)
        for q in (before, after)
    )
    turn = (first.inv() * second).as_rotvec().ravel()
    rate = np.concatenate([after[:3] - before[:3], turn]) / DT
    np.testing.assert_allclose(qvel_at(refs, 1, time), rate, atol=0.05)


def test_other_clips_hold_their_ends_at_rest(refs):
    assert float(qpos_at(refs, 2, -3.0)[0]) == 50.0
    assert float(qpos_at(refs, 0, 9.0)[0]) == pytest.approx(1.0, abs=1e-5)
    assert float(qvel_at(refs, 0, 0.5)[0]) == pytest.approx(1.0, abs=1e-3)
    assert not np.any(qvel_at(refs, 0, 9.0))


def test_initial_state_has_the_pose_of_one_control_step_ago(states):
    plain, _ = states
    assert plain.qpos.shape == (100, 55) and plain.qvel.shape == (100, 42)
    step = np.linalg.norm((plain.qpos - plain.qpos_previous)[:, :2], axis=-1)
    speed = np.where(plain.clip == 1, 2.6, 1.0)
    np.testing.assert_allclose(step, speed * DT, rtol=1e-2)
    np.testing.assert_allclose(
        np.linalg.norm(plain.qvel[:, :3], axis=-1), speed, rtol=1e-2
    )


def test_sampling_can_take_the_start_of_a_clip(refs):
    keys = jax.random.split(jax.random.key(5), 20)
    states = jax.vmap(lambda key: refs.sample(key, begin=True))(keys)
    first = np.where(refs.loop[states.clip], 0.0, refs.control_dt)
    np.testing.assert_allclose(states.time, first, atol=1e-6)
    assert len(set(np.asarray(states.clip).tolist())) > 1


def test_a_loop_travels_at_its_mean_velocity_and_other_clips_do_not(refs, states):
    # The chord of one period on the circle of 2 m, then turned by what it turns.
    chord, angle = 4.0 * np.sin(0.65), 0.65
    for periods in (0, 2):
        travel = refs.state_at(1, periods + 0.3).travel
        heading = angle + 1.3 * periods
        expected = [chord * np.cos(heading), chord * np.sin(heading)]
        np.testing.assert_allclose(travel, expected, atol=1e-3)
    assert not np.any(refs.state_at(0, 0.5).travel)
    plain, moved = states
    going = plain.clip == 1
    speeds = np.linalg.norm(moved.travel[going], axis=-1)
    np.testing.assert_allclose(speeds, chord, rtol=1e-3)
    assert np.ptp(np.arctan2(*moved.travel[going].T)) > 3.0


def test_random_heading_turns_pose_and_velocity_together(states):
    plain, moved = states
    turn = Rotation.from_quat(moved.qpos[:, 3:7], scalar_first=True) * (
        Rotation.from_quat(plain.qpos[:, 3:7], scalar_first=True).inv()
    )
    assert np.median(turn.magnitude()) > 1.0
    np.testing.assert_allclose(turn.as_rotvec()[:, :2], 0.0, atol=1e-3)
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    close(turn.apply(plain.qvel[:, :3]), moved.qvel[:, :3])
    steps = [(state.qpos - state.qpos_previous)[:, :3] for state in states]
    close(turn.apply(steps[0]), steps[1])
    np.testing.assert_array_equal(plain.qpos[:, 7:], moved.qpos[:, 7:])


def on_circle(poses: np.ndarray) -> np.ndarray:
    """Which windows [N] are of the circle: the only clip whose joints move."""
    return np.abs(np.diff(poses[:, :, 9], axis=1)).max(1) > 1e-4


def test_windows_never_reach_past_an_end(windows):
    for poses in windows:
        assert poses.shape == (len(SPANS), 4, 55)
        # A window held at an end, or taken from two clips, would have another step.
        straight = ~on_circle(poses)
        steps = np.diff(poses[straight][:, :, 0], axis=1) / DT
        expected = np.stack([np.ones(len(SPANS)), SPANS - 1, np.ones(len(SPANS))], 1)
        np.testing.assert_allclose(steps, expected[straight], atol=1e-3)


def test_a_window_wider_than_its_clip_holds_the_last_pose(refs):
    wide = np.asarray(refs.sample_windows(jax.random.key(1), np.full(200, 40))[0])
    steps = np.diff(wide[~on_circle(wide)][:, :, 0], axis=1)
    np.testing.assert_allclose(steps[:, 0], DT, atol=2e-5)
    np.testing.assert_allclose(steps[:, 2], 0.0, atol=2e-5)
    assert np.isfinite(wide).all()


def test_clips_are_drawn_by_weight_and_anew_for_every_key(windows):
    for poses in windows:
        far, circle = poses[:, 0, 0] > 20.0, on_circle(poses)
        shares = [np.mean(~far & ~circle), np.mean(circle), np.mean(far)]
        np.testing.assert_allclose(shares, [3 / 6, 2 / 6, 1 / 6], atol=0.04)
        assert poses[:, :, 0].max() < 70.0
    assert not np.array_equal(windows[0], windows[1])


def test_phase_follows_the_clip_or_its_share_of_the_duration(refs):
    assert float(refs.phase_at(0, 0.25)) == pytest.approx(0.25, abs=1e-5)
    assert float(refs.phase_at(2, 2 * DT)) == pytest.approx(0.75, abs=1e-5)


def test_planar_motion_keeps_height_and_joints(refs):
    pose = qpos_at(refs, 1, 0.3)
    moved = planar_moved(pose, jnp.float32(0.7), jnp.array([1.0, -2.0]))
    np.testing.assert_array_equal(moved[7:], pose[7:])
    assert float(moved[2]) == pytest.approx(float(pose[2]), abs=1e-6)


@pytest.mark.parametrize(
    ("clips", "options", "message"),
    [
        ([], {}, "clips is empty"),
        ([line(0, 1)], {"weights": [1.0, 2.0]}, "weights has 2 values for 1 clips"),
        ([line(0, 1)], {"weights": [-1.0]}, "weights must be >= 0"),
        ([line(0, 1)], {"weights": [0.0]}, "positive sum"),
        ([line(0, 1)], {"control_dt": 0.0}, "control_dt must be positive"),
        ([line(0, 1)], {"control_dt": 0.6}, "lasts 1.000 s, less than 1.200"),
    ],
)
def test_impossible_sets_are_refused(clips, options, message):
    with pytest.raises(ValueError, match=message):
        make_references(clips, **options)
