"""Trained policies act in the task they were trained in, its parameters included."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dcc_jax import config
from dcc_jax.character import asset_path
from dcc_jax.evaluate import report
from dcc_jax.play import runs
from dcc_jax.tasks.door import Door


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a policy that was trained with a door of 1.3 m."""
    shipped, run_dir = asset_path("policies/door"), tmp_path_factory.mktemp("door")
    shutil.copy(shipped / "policy.npz", run_dir)
    made = config.load(shipped).with_({"task.width": 1.3})
    (run_dir / "config.json").write_text(config.to_json(made))
    return run_dir


def _plan(run_dir, alpha=None, task=None) -> report.EvaluationPlan:
    return report.prepare(run_dir, 4, alpha, 0, 1.0, task, lambda text: None)


def test_run_is_evaluated_with_the_parameters_of_its_training(wide):
    (player,) = _plan(wide).players.values()
    assert player.environment.task == Door(width=1.3)
    hinge = player.environment.scene.model.body("door").pos
    (shipped,) = _plan("door").players.values()
    assert hinge[1] != shipped.environment.scene.model.body("door").pos[1]


def test_runs_of_other_parameters_do_not_share_a_program(wide):
    players = _plan([wide, "door"]).players
    assert {p.environment.task for p in players.values()} == {Door(1.3), Door(1.0)}


def test_parameters_can_be_others_than_in_training(wide):
    run = runs.find_run(wide)
    assert runs.make_environment(run, {"width": 1.5}).task == Door(width=1.5)
    assert runs.make_environment(run, {"reach": 0.1}).task == Door(1.3, reach=0.1)
    assert runs.make_environment(run, Door(density=9.0)).task == Door(density=9.0)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ({"widht": 1.5}, r"unknown entry task\.widht; task has width, density"),
        ({"width": "wide"}, r"task\.width must be a number, got 'wide'"),
        ({"width": 0.0}, "width must be positive"),
    ],
)
def test_parameters_that_make_no_sense_are_named(wide, task, said):
    with pytest.raises(ValueError, match=said):
        runs.make_environment(runs.find_run(wide), task)


def test_one_level_of_compliance_needs_no_sequence(wide):
    assert [c.alpha for _, c in _plan(wide, alpha=0.1).conditions] == [0.1]
    with pytest.raises(ValueError, match=r"alpha must be in \[0, 0.9\], got 2"):
        _plan(wide, alpha=2)
