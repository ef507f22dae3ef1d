"""The planner of strides: loops at their own speeds, something between elsewhere."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dcc_jax import config, tasks
from dcc_jax.character import CONTROL_DT, asset_path, compose_scene, load_character
from dcc_jax.motion import planner
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.paths import Motion
from dcc_jax.motion.reference import References, make_references
from dcc_jax.tasks.hand_in_hand import HandInHand

PHASES = np.arange(48) / 48


def _references(*names: str) -> References:
    return make_references(
        [load_clip(asset_path(f"motions/{name}.npz")) for name in names]
    )


@pytest.fixture(scope="module")
def references() -> References:
    return _references(*HandInHand.clips)


@pytest.fixture(scope="module")
def loops(references) -> planner.Strides:
    return planner.strides(references)


@pytest.fixture(scope="module")
def pose(references, loops):
    """(phase, speed, time) -> qpos [55]."""
    return jax.jit(lambda *at: loops.pose(references, *at))


def _apart(references, qpos) -> np.ndarray:
    """How far the left foot is ahead of the right one at each pose, m."""
    model = compose_scene(load_character(), floor=False)
    data = mujoco.MjData(model)
    gaps = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        gaps.append(data.body("left_foot").xpos[0] - data.body("right_foot").xpos[0])
    return np.array(gaps)


def test_loops_come_in_the_order_of_their_speeds(references, loops):
    names = [references.names[clip] for clip in loops.clips]
    assert names[0] == "stand" and names[-1] == "run_cycle"
    assert list(loops.speeds) == sorted(loops.speeds)
    assert loops.cadences[0] == loops.cadences[1], "who begins to walk has a cadence"


def test_at_the_speed_of_a_loop_it_is_that_loop(references, loops, pose):
    for index in range(1, len(loops.clips)):
        clip, speed = loops.clips[index], loops.speeds[index]
        for phase in (0.1, 0.6):
            stride = (phase + loops.offsets[index]) % 1.0
            own = references.qpos_at(clip, stride * references.duration[clip])
            made = pose(jnp.array(phase), jnp.array(speed), jnp.zeros(()))
            off = np.abs(np.array(made[2:]) - np.array(own[2:])).max()
            assert off < 2e-3, references.names[clip]


def test_all_loops_put_the_left_foot_forward_at_one_phase(references, loops, pose):
    peaks = []
    for speed in loops.speeds[1:]:
        qpos = [pose(jnp.array(p), jnp.array(speed), jnp.zeros(())) for p in PHASES]
        wave = np.fft.fft(_apart(references, qpos))[1]
        peaks.append(np.angle(wave))
    off = np.angle(np.exp(1j * (np.array(peaks) - peaks[0])))
    assert np.abs(off).max() < 0.6, "a tenth of a stride"


def test_strides_grow_with_speed(references, pose):
    widths = []
    for speed in (0.0, 0.4, 0.8, 1.2, 1.6):
        qpos = [pose(jnp.array(p), jnp.array(speed), jnp.zeros(())) for p in PHASES]
        widths.append(np.ptp(_apart(references, qpos)))
    assert widths[0] < 0.02 and np.all(np.diff(widths) > 0.1)


@pytest.mark.parametrize("speed", [0.0, 1.0, 2.6])
def test_what_it_begins_with_moves_as_it_says(references, loops, speed):
    state = planner.begin(
        references, loops, jnp.array(0.3), jnp.array(speed), CONTROL_DT
    )
    np.testing.assert_array_equal(state.sway, state.qpos[:2])
    assert np.abs(state.sway).max() < 0.06
    np.testing.assert_allclose(state.travel, [speed, 0.0])
    model = compose_scene(load_character(), floor=False)
    gone = np.zeros(42)
    mujoco.mj_differentiatePos(
        model,
        gone,
        CONTROL_DT,
        np.array(state.qpos_previous, float),
        np.array(state.qpos, float),
    )
    np.testing.assert_allclose(state.qvel, gone, atol=2e-3)


@pytest.mark.parametrize("speed", [0.8, 2.6])
def test_what_it_begins_with_goes_at_its_speed_on_average(references, loops, speed):
    begin = jax.vmap(
        lambda p: planner.begin(references, loops, p, jnp.array(speed), CONTROL_DT)
    )
    begun = begin(jnp.asarray(PHASES))
    moved = (begun.qpos - begun.qpos_previous)[:, :2] / CONTROL_DT
    for velocity in (begun.qvel[:, :2], moved):
        np.testing.assert_allclose(velocity.mean(axis=0), [speed, 0.0], atol=0.02)
    np.testing.assert_allclose(
        begun.qvel[:, :2] - begun.sway_velocity, begun.travel, atol=1e-5
    )


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (("walk_cycle", "walk"), "clips must be loops, walk is none"),
        (("walk_cycle",), "two loops or more"),
        (("walk_cycle", "walk_cycle"), "different speeds"),
    ],
)
def test_clips_that_make_no_planner_are_refused(names, reason):
    with pytest.raises(ValueError, match=reason):
        planner.strides(_references(*names))


@pytest.mark.parametrize("task", ["chicken-fight", "hand-in-hand", "sustained-push"])
def test_clips_that_do_not_suit_the_task_are_refused_before_anything_is_traced(task):
    made = config.make_config(task)
    env = dataclasses.replace(made.env, clips=("backflip",))
    with pytest.raises(ValueError, match=r"env\.clips must be .*loops"):
        tasks.make_environment(made.task, env)


def _going(speed: float, turn: float = 0.0) -> Motion:
    """Goes on at a speed in m/s, in a curve of so many rad/s."""
    goes, turns, zero = jnp.array(speed), jnp.array(turn), jnp.zeros(())
    return Motion(
        time=zero,
        position=jnp.zeros(2),
        heading=zero,
        speed=goes,
        acceleration=zero,
        turn=turns,
        wanted_speed=goes,
        wanted_turn=turns,
        left=zero,
    )


def _gone(references, loops, motion: Motion, steps: int):
    """The reference at each control step, leaves [steps, ...]."""

    @jax.jit
    def run(first):
        def step(at, _):
            later = planner.go_on(references, loops, motion, at, CONTROL_DT)
            return later, later

        return jax.lax.scan(step, first, None, length=steps)[1]

    phase = jnp.array(0.3)
    first = planner.begin(references, loops, phase, motion.speed, CONTROL_DT)
    return jax.tree.map(lambda x: np.array(x, float), run(first))


def test_root_sways_about_the_path_as_in_the_loop(references, loops):
    """Where it went evenly, soles that stand would slide by 12 to 21 cm/s."""
    for index in range(1, len(loops.clips)):
        clip, speed = loops.clips[index], loops.speeds[index]
        gone = _gone(references, loops, _going(speed), 45)
        time = np.arange(1, 46) * CONTROL_DT
        stride = 0.3 + loops.offsets[index] + time * loops.cadences[index]
        at = jnp.asarray(stride) * references.duration[clip]
        own = jax.vmap(lambda t, clip=clip: references.qpos_at(clip, t))(at)
        beside = gone.qpos[:, :2] - np.array(own[:, :2])
        assert np.ptp(beside, axis=0).max() < 4e-3, references.names[clip]
        path = np.stack([speed * time, 0.0 * time], axis=1)
        sway = gone.qpos[:, :2] - path
        np.testing.assert_allclose(gone.sway, sway, atol=1e-5)
        assert 0.01 < np.ptp(sway, axis=0).max() < 0.08
        whole = round(1.0 / loops.cadences[index] / CONTROL_DT)
        assert np.abs(sway[:whole].mean(axis=0)).max() < 4e-3


def test_the_velocity_as_it_goes_on_is_that_of_its_poses(references, loops):
    """Running in a curve, for as long as the path of one control step is an arc."""
    path = _gone(references, loops, _going(2.6, turn=0.4), 6)
    model = compose_scene(load_character(), floor=False)
    rate = np.zeros(42)
    for i in range(1, 5):
        before, after = path.qpos[i - 1], path.qpos[i + 1]
        mujoco.mj_differentiatePos(model, rate, 2.0 * CONTROL_DT, before, after)
        np.testing.assert_allclose(path.qvel[i], rate, atol=5e-3)
    assert np.abs(path.qvel[:, 6:]).max() > 3.0
