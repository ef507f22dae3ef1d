"""drag.py: stiffness out of coordinates that are known."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dcc_jax.character import asset_path, compose_scene, load_character
from dcc_jax.config import make_config
from dcc_jax.control.stiffness import softened_gains, stiffness
from dcc_jax.evaluate import drag, rest, show_drag
from dcc_jax.evaluate.dragging import BODIES, DIRECTIONS, NEWTONS, Trials
from dcc_jax.motion.clip import load_clip
from dcc_jax.play.runs import find_run

CHARACTER = load_character()
MODEL = compose_scene(CHARACTER, floor=False)
STEPS = 90
POSES = load_clip(asset_path("motions/stand.npz")).qpos


def yielding(factor: float):
    """Episodes of a character that yields `factor` times as far as Eq. (7) says.

    It also drifts over the ground and turns with a force, which is no yield of a body.
    """

    def play(run, trials, alpha, seed):
        kp = factor_of_gains(alpha, factor)
        q = np.zeros((STEPS, len(trials.body), MODEL.nq))
        for k, (episode, body, force) in enumerate(
            zip(trials.episode, trials.body, trials.force, strict=True)
        ):
            pose = POSES[7 * episode].astype(float)
            tangent = np.zeros(MODEL.nv)
            if body >= 0:
                tangent[6:] = rested(pose, BODIES[body], force, kp)
                tangent[:3] = force / 1000.0
            mujoco.mj_integratePos(MODEL, pose, tangent, 1.0)
            q[:, k] = pose
        return q, np.zeros(len(trials.body), bool)

    return play


def factor_of_gains(alpha: float, factor: float) -> np.ndarray:
    return softened_gains(CHARACTER.kp, CHARACTER.column_weight, alpha)[6:] / factor


def rested(pose: np.ndarray, body: str, force: np.ndarray, kp: np.ndarray):
    """Rotation vectors [36] at which joints with gains kp rest, with J there."""
    data, J = mujoco.MjData(MODEL), np.zeros((3, MODEL.nv))
    at, y = MODEL.body(body).id, np.zeros(MODEL.nv)
    for _ in range(40):
        data.qpos[:] = pose
        mujoco.mj_integratePos(MODEL, data.qpos, y, 1.0)
        mujoco.mj_forward(MODEL, data)
        mujoco.mj_jac(MODEL, data, J, None, data.xipos[at], at)
        y[6:] += 0.5 * ((J.T @ force)[6:] / kp - y[6:])
    return y[6:]


def measured(alpha: float, factor: float = 1.0) -> drag.Drag:
    environment = SimpleNamespace(scene=SimpleNamespace(character=CHARACTER))
    trials = Trials.of(2)
    # So small that no joint comes near the end of its range.
    trials = Trials(trials.episode, trials.body, 0.02 * trials.force)
    plan = SimpleNamespace(environment=environment, trials=trials, run=None, seed=0)
    return drag._measured(plan, alpha, yielding(factor))


def test_who_yields_by_eq_7_is_as_stiff_as_theory_says():
    found = measured(0.5)
    soft = found.theory < 1e4  # elsewhere it yields by less than single precision
    assert soft.mean() > 0.5
    np.testing.assert_allclose(found.measured[soft], found.theory[soft], rtol=0.03)
    for body in BODIES:
        assert found.share_near(body).value > 0.9
        value = found.stiffness(body)
        assert value.low <= value.value <= value.high
        assert value.value == pytest.approx(found.expected(body), rel=0.02)


@pytest.mark.parametrize(("body", "newtons"), [("left_hand", 40.0), ("head", 60.0)])
def test_rest_under_a_large_force_is_where_springs_have_it(body, newtons):
    """C MuJoCo, pelvis held, a spring in every joint, settled."""
    alpha, force = 0.5, np.array([0.8 * newtons, 0.6 * newtons, 0.0])
    kp = factor_of_gains(alpha, 1.0)
    spec = CHARACTER.spec()
    spec.option.gravity[:] = 0.0
    spec.option.timestep = 0.002
    model = spec.compile()
    pose = POSES[0].astype(float)
    pose[:7] = model.qpos0[:7]
    model.qpos_spring[:] = pose
    model.jnt_stiffness[1:] = kp[::3]
    model.dof_damping[6:] = 0.3 * kp
    model.body_mass[1], model.body_inertia[1] = 1e6, 1e6
    model.jnt_limited[:] = 0
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    at = model.body(body).id
    mujoco.mj_forward(model, data)
    before = data.xipos[at] - data.qpos[:3]
    data.xfrc_applied[at, :3] = force
    mujoco.mj_step(model, data, 2000)
    assert np.abs(data.qvel[6:]).max() < 1e-3
    expected = data.xipos[at] - data.qpos[:3] - before
    (found,) = rest.yields_at_rest(
        CHARACTER, (body,), alpha, pose[None], force[None], np.zeros(1, int)
    )
    far = np.linalg.norm(expected)
    assert far > 0.04
    assert np.linalg.norm(found - expected) < 0.01 * far
    # K_hat at the first pose is not enough.
    gains = np.concatenate([np.ones(6), kp])
    K_hat = stiffness(MODEL, pose, body, MODEL.body(body).ipos, gains)
    assert np.linalg.norm(np.linalg.solve(K_hat, force) - expected) > 0.05 * far


def test_who_yields_half_as_far_is_twice_as_stiff_and_not_near():
    found = measured(0.5, 0.5)
    soft = found.theory < 1e4
    np.testing.assert_allclose(found.measured[soft], 2 * found.theory[soft], rtol=0.03)
    assert found.share_near("left_hand").value == 0.0


def test_slope_is_one_where_theory_holds_and_zero_where_alpha_does_nothing():
    levels = (0.0, 0.5, 0.8)
    assert drag.slope([measured(a) for a in levels], "left_hand") == pytest.approx(
        1.0, abs=0.02
    )
    # Yields as at alpha 0 whatever it is told: 1 / (1 + alpha / (1 - alpha)) as far.
    stiff = [measured(a, 1.0 - a) for a in levels]
    assert abs(drag.slope(stiff, "chest")) < 0.1


def test_every_body_direction_and_force_is_tried_in_every_episode():
    trials = Trials.of(3)
    assert len(trials.body) == 3 * (1 + len(BODIES) * len(NEWTONS) * len(DIRECTIONS))
    alone = trials.body < 0
    assert list(trials.episode[alone]) == [0, 1, 2] and not trials.force[alone].any()
    assert len({tuple(f) for f in trials.force[~alone]}) == 6 * len(NEWTONS)


def test_a_trial_that_falls_at_one_level_counts_for_the_slope_at_none():
    drags = [measured(a) for a in (0.0, 0.5)]
    fallen = np.flatnonzero(drags[1].body == 0)[:20]
    drags[1].fell[fallen] = True
    drags[1].measured[fallen] = np.nan
    drags[0].measured[fallen] = 1e-3
    assert drag.slope(drags, "left_hand") == pytest.approx(1.0, abs=0.02)


def test_a_body_that_balance_moves_against_the_force_is_stiffer_than_all_others():
    """Two of five trials at the head yield backwards, by balance: the median is of the
    stiffest that yields."""
    found = measured(0.5)
    head = found.at("head")
    found.measured[head] = np.resize([-9e4, -5e3, 4e3, 2e3, 1e3], len(head))
    assert found.stiffness("head").value == pytest.approx(4e3)
    assert found.stiffness("head").low <= 4e3


def test_levels_are_those_of_the_training_where_it_had_none_of_the_usual():
    run = find_run("push")
    config = run.config.with_({"env.alpha": 0.2, "env.alpha_max": 0.25})
    run = dataclasses.replace(run, config=config)
    assert drag.prepare(run, None, 1, 0, None).alpha == [0.2, 0.25]
    with pytest.raises(ValueError, match="alpha must hold a level"):
        drag.prepare(run, [], 1, 0, None)


def test_a_clip_that_ends_before_the_force_is_refused():
    with pytest.raises(ValueError, match=r"a drag lasts 7 s, and the clip backflip"):
        drag.prepare(find_run("backflip"), None, 1, 0, None)


def test_a_law_without_a_static_stiffness_is_refused():
    config = make_config("push", "smoke").with_(
        {"env.compliance.law": "algorithm_1", "env.alpha": 0.0}
    )
    run = SimpleNamespace(config=config, alphas=(0.0, 0.1))
    with pytest.raises(ValueError, match="'admittance', and the law is 'algorithm_1'"):
        drag.prepare(run, None, 1, 0, None)


def test_small_yields_can_be_left_out():
    found = measured(0.5)
    everything, far = found.at("left_hand"), found.at("left_hand", 0.005)
    assert 0 < len(far) < len(everything)
    assert np.all(found.newtons[far] / found.theory[far] >= 0.005)


def test_who_fell_does_not_count():
    found = measured(0.5)
    found.fell[found.body == 0] = True
    assert np.isnan(found.stiffness(BODIES[0]).value)
    assert np.isnan(found.share_near(BODIES[0]).value)
    cells = [list(c.cells) for c in show_drag.table("run", [found]).columns]
    assert [column[0] for column in cells[3:6]] == ["-", "-", "-"]
    assert found.share_near(BODIES[1]).value > 0.9


def test_table_json_and_figure_tell_the_same(tmp_path: Path):
    drags = [measured(0.0), measured(0.5)]
    assert show_drag.table("run", drags).row_count == len(BODIES) * 3
    data = json.loads(show_drag.to_json("run", drags))
    assert [level["alpha"] for level in data["levels"]] == [0.0, 0.5]
    assert len(data["levels"][0]["measured"]) == len(drags[0].measured)
    show_drag.figure("run", drags, tmp_path / "drag.png")
    assert (tmp_path / "drag.png").stat().st_size > 10_000
