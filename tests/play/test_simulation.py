"""One character to play with: theory, inputs, and what goes wrong."""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np
import pytest
from held import held_run

from dcc_jax.character import compose_scene
from dcc_jax.control.stiffness import deflection, stiffness
from dcc_jax.play import player as player_module
from dcc_jax.play import pull
from dcc_jax.play.player import Player
from dcc_jax.play.program import Program
from dcc_jax.play.runs import find_run, make_environment
from dcc_jax.play.simulation import HISTORY, Simulation

HAND = "left_hand"
FORCE = np.array([20.0, 40.0, -22.36])  # N, 50 N together
AWAY = np.array([0.0, 0.03, -0.02])  # m, from the hand to the end of the spring
SETTLING = 150  # control steps, 5 s


@pytest.fixture(scope="module")
def program() -> Program:
    return Program(held_run())


@pytest.fixture
def simulation(program: Program) -> Simulation:
    simulation = Simulation(held_run(), program)
    simulation.alpha = 0.0
    simulation.reset(episode=0)
    return simulation


def hand_at(simulation: Simulation, qpos: np.ndarray) -> np.ndarray:
    """Centre of mass of the hand [3], m, world, by C MuJoCo."""
    model = simulation.environment.scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data.xipos[model.body(HAND).id].copy()


def settled(simulation: Simulation, steps: int = SETTLING) -> np.ndarray:
    """qpos after a while."""
    for _ in range(steps):
        simulation.step()
    return np.asarray(simulation.history[-1].motion.qpos, float)


def rest_under(
    simulation: Simulation, qpos: np.ndarray, force: np.ndarray, alpha: float
) -> np.ndarray:
    """Where the joints rest, Eq. (2) with qd = 0: kp log(q^-1 q_bar) + J^T f = 0.

    The joints turn by w = J^T f / kp away from q_bar = q_m (+) u, and u turns them by
    alpha / (1 - alpha) W J^T f / kp, about the same axis.
    """
    scene = simulation.environment.scene
    model, character = scene.model, scene.character
    data, J = mujoco.MjData(model), np.empty((3, model.nv))
    body, w = model.body(HAND).id, np.zeros(model.nv)
    share = 1.0 + alpha / (1.0 - alpha) * character.column_weight[6:]
    for _ in range(60):
        data.qpos[:] = qpos
        mujoco.mj_integratePos(model, data.qpos, w, 1.0)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, J, None, data.xipos[body], body)
        w[6:] = share * (J.T @ force)[6:] / character.kp[6:]
    return data.qpos.copy()


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_50_N_at_a_hand_of_a_fixed_base_end_where_theory_says(simulation, alpha):
    free = settled(simulation)
    simulation.alpha = alpha
    simulation.push(HAND, FORCE, 100.0)
    moved = hand_at(simulation, settled(simulation, 2 * SETTLING))
    expected = hand_at(simulation, rest_under(simulation, free, FORCE, alpha))
    far = np.linalg.norm(expected - hand_at(simulation, free))
    assert far > 0.03
    assert np.linalg.norm(moved - expected) < 0.01 * far


def test_small_pull_deflects_by_the_inverse_of_the_stiffness(simulation):
    """K = (J Kp^-1 J^T)^-1, Eq. (4), and a spring in the hand: f = k (target - x)."""
    free = settled(simulation)
    place, k = hand_at(simulation, free), 100.0
    model, scene = simulation.environment.scene.model, simulation.environment.scene
    point = model.body_ipos[model.body(HAND).id]
    simulation.pull(HAND, point, place + AWAY, k)
    moved = hand_at(simulation, settled(simulation))
    force = simulation.pull_force_w
    np.testing.assert_allclose(force, k * (place + AWAY - moved), rtol=0.01, atol=0.01)
    alone = compose_scene(scene.character, floor=False)
    K = stiffness(alone, free, HAND, point, scene.character.kp)
    expected = deflection(K, force)
    assert np.linalg.norm(moved - place - expected) < 0.02 * np.linalg.norm(expected)


def test_alpha_acts_at_once_and_u_off_tells_it_to_the_policy_alone(simulation):
    simulation.push(HAND, FORCE, 100.0)
    assert settled(simulation, 20) is not None
    assert simulation.history[-1].numbers["displacement"] < 1e-5
    simulation.alpha = 0.5
    settled(simulation, 20)
    assert simulation.history[-1].numbers["displacement"] > 0.02
    simulation.u_on = False
    settled(simulation, 1)
    assert simulation.history[-1].numbers["displacement"] < 1e-5
    assert simulation.told == pytest.approx(0.5)
    assert simulation.level == 0.0


def test_same_seed_and_episode_are_the_same_states_to_the_bit(simulation):
    first = settled(simulation, 10)
    simulation.push(HAND, FORCE, 100.0)
    settled(simulation, 5)
    simulation.reset(seed=0, episode=0)
    np.testing.assert_array_equal(settled(simulation, 10), first)


def test_push_ends_by_itself_and_a_pull_when_let_go(simulation):
    simulation.push("chest", np.array([30.0, 0.0, 0.0]), 0.2)
    peaks = [simulation.step().numbers["force_peak"] for _ in range(8)]
    np.testing.assert_allclose(peaks[:6], 30.0, rtol=1e-5)
    assert peaks[6:] == [0.0, 0.0]
    simulation.pull("head", np.zeros(3), np.array([1.0, 0.0, 2.0]), 100.0)
    assert simulation.step().numbers["force_peak"] > 10.0
    simulation.release()
    assert simulation.step().numbers["force_peak"] == 0.0


def test_history_is_of_ten_seconds(simulation):
    settled(simulation, HISTORY + 5)
    assert len(simulation.history) == HISTORY
    assert simulation.history[-1].time == pytest.approx((HISTORY + 5) / 30)


def test_pull_of_a_million_newtons_is_contained(simulation):
    simulation.pull(HAND, np.zeros(3), np.array([0.0, 1e6, 0.0]), 1e6)
    ended = [simulation.step().ended for _ in range(30)]
    assert any(ended)
    simulation.release()
    assert np.isfinite(settled(simulation, 10)).all()
    assert simulation.history[-1].numbers["force_peak"] == 0.0


def test_state_that_is_not_a_number_begins_a_new_episode(simulation):
    settled(simulation, 3)
    body = simulation.state.body
    broken = dataclasses.replace(body, qvel=np.full_like(body.qvel, np.nan))
    simulation.state = dataclasses.replace(simulation.state, body=broken)
    assert simulation.step().ended == "the physics broke"
    simulation.step()
    assert simulation.episode == 1
    assert np.isfinite(settled(simulation, 3)).all()


def test_wrong_body_or_number_is_named(simulation):
    with pytest.raises(ValueError, match="tail"):
        simulation.pull("tail", np.zeros(3), np.zeros(3), 100.0)
    with pytest.raises(ValueError, match="target_w must be finite"):
        simulation.pull(HAND, np.zeros(3), np.full(3, np.nan), 100.0)
    with pytest.raises(ValueError, match="force_w must be finite"):
        simulation.push(HAND, np.full(3, np.inf), 1.0)
    with pytest.raises(ValueError, match="throw"):
        simulation.act("throw")
    assert not any(np.any(x) for x in jax.tree.leaves(simulation.hands))


@pytest.mark.slow
def test_episode_without_pulls_is_evaluates_to_the_bit(monkeypatch):
    """One environment a device: how many share a program changes the last digit."""
    monkeypatch.setattr(player_module, "WIDTHS", (1,))
    run, steps = find_run("push"), 45
    levels, told = [0.16, 0.0], [0.16, 0.1]
    recording = Player(make_environment(run)).play(
        run, [0, 1], levels, observed_alpha=told, seconds=steps / 30, motion=True
    )
    assert recording.motion is not None
    simulation = Simulation(run, Program(run))
    for episode in (0, 1):
        simulation.alpha, simulation.u_on = told[episode], levels[episode] > 0.0
        simulation.reset(episode=episode)
        for step in range(steps):
            motion = simulation.step().motion
            for name in ("qpos", "u"):
                np.testing.assert_array_equal(
                    getattr(motion, name),
                    getattr(recording.motion, name)[step, episode],
                )
            np.testing.assert_array_equal(
                motion.force_w[: -pull.HANDS],
                recording.motion.force_w[step, episode],
            )
