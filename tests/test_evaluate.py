"""Evaluation of a policy that was hardly trained: pairs, physics, output, bad input."""

from __future__ import annotations

import dataclasses
import importlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec
from matplotlib.image import imread

import smoke
from dcc_jax.control import compliance
from dcc_jax.env.observation import ALPHA_ENTRY
from dcc_jax.evaluate import report, show
from dcc_jax.play import runs
from dcc_jax.play.player import Player
from dcc_jax.play.recording import Recording
from dcc_jax.tasks.push import Push

# The package shows the function of that name; these tests want the module.
command = importlib.import_module("dcc_jax.evaluate.__main__")

pytestmark = pytest.mark.xdist_group("push")
FIRST_ROWS = "fell", "survived (s)", "task/speed/mean", "contact/peak (N)"
EPISODES, SECONDS, GRAVITY = 8, 1.5, 9.81
Seen = tuple[Player, Recording, report.Report]


@pytest.fixture(scope="module")
def push(smoke_run: Callable[[str], Path]) -> Path:
    return smoke_run("push")


@pytest.fixture(scope="module")
def plan(push: Path) -> report.EvaluationPlan:
    """Two levels of one policy and a control arm; its program serves the file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "Player", smoke.player)
        return report.prepare(push, EPISODES, None, 3, SECONDS, None, lambda text: None)


@pytest.fixture(scope="module")
def found(plan: report.EvaluationPlan) -> report.Report:
    return report.execute(plan, lambda done, total: None)


def _trained_at(run: runs.Run, alpha: float) -> runs.Run:
    """The policy as if it had been trained at one level, which it then observes."""
    env = dataclasses.replace(run.config.env, alpha=alpha, alpha_max=None)
    return dataclasses.replace(run, config=dataclasses.replace(run.config, env=env))


def _play(
    plan: report.EvaluationPlan, alpha: float, observed: float = 0.16, sense: float = 1
) -> Recording:
    """Episodes of a policy whose weights of alpha are `sense` times its own."""
    run, _ = plan.conditions[0]
    first, *rest = run.policy.params.layers
    kernel = jnp.asarray(first.kernel).at[ALPHA_ENTRY].multiply(sense)
    layers = (dataclasses.replace(first, kernel=kernel), *rest)
    params = dataclasses.replace(run.policy.params, layers=layers)
    policy = dataclasses.replace(run.policy, params=params)
    return plan.players[run.name].play(
        dataclasses.replace(run, policy=policy),
        range(EPISODES),
        [alpha] * EPISODES,
        observed_alpha=[observed] * EPISODES,
        seed=3,
        seconds=SECONDS,
        motion=True,
    )


@pytest.fixture(scope="module")
def recordings(plan: report.EvaluationPlan) -> tuple[Recording, Recording]:
    """At alpha = 0 and at the largest that the law has, where the difference shows."""
    run, _ = plan.conditions[0]
    greatest = run.config.env.compliance.greatest_alpha
    return _play(plan, 0.0), _play(plan, greatest)


def test_levels_of_compliance_meet_the_same_balls(recordings):
    rigid, yielding = (r.motion.qpos for r in recordings)
    np.testing.assert_array_equal(rigid[0, :, 55:], yielding[0, :, 55:])
    # Up to the first contact the episodes are the same; a ball tells them apart.
    forces = [r.numbers["contact_share"].cumsum(axis=0) > 0 for r in recordings]
    untouched = ~forces[0] & ~forces[1]
    assert untouched.sum() > 50
    np.testing.assert_array_equal(rigid[untouched], yielding[untouched])
    hit = forces[0] & recordings[0].alive & recordings[1].alive
    assert np.abs(rigid[hit] - yielding[hit]).max() > 1e-5
    assert recordings[1].numbers["displacement"][hit].max() > 1e-4


def test_u_is_exactly_zero_in_the_control_arm(plan, recordings):
    control, compliant = recordings
    (environment,) = {player.environment for player in plan.players.values()}
    rest = compliance.at_rest(environment.kinematics.coords).u
    u = control.motion.u[control.alive]
    np.testing.assert_array_equal(u, np.broadcast_to(rest, u.shape))
    assert np.abs(compliant.motion.u[compliant.alive] - rest).max() > 1e-4
    for name in ("displacement", "root_displacement"):
        assert (control.numbers[name][control.alive] == 0.0).all()


def test_control_arm_is_alpha_zero_for_a_policy_that_ignores_alpha(plan):
    """And is not for one that heeds it: alpha enters nothing but u and what is seen."""
    for sense, same in ((0.0, True), (3.0, False)):
        told, baseline = (_play(plan, 0.0, x, sense).motion.qpos for x in (0.16, 0.0))
        assert np.array_equal(told, baseline) == same


def test_episodes_differ_and_depend_on_the_seed_alone(plan, recordings):
    again = _play(plan, 0.0)
    first = recordings[0].motion.qpos
    np.testing.assert_array_equal(again.motion.qpos, first)
    assert len({row.tobytes() for row in first[0]}) == EPISODES


def test_impulse_of_a_contact_is_what_the_ball_lost(plan, recordings):
    """Newton's third law: 1 kg times the change of the ball's velocity."""
    run, _ = plan.conditions[0]
    model = plan.players[run.name].environment.scene.model
    start = int(model.joint("ball").qposadr[0])
    ball, dt = recordings[0].motion.qpos[..., start : start + 3], 1.0 / 30.0
    down = np.array([0.0, 0.0, GRAVITY])
    compared = []
    for n in range(EPISODES):
        share = recordings[0].numbers["contact_share"][:, n]
        edges = np.diff(np.pad(share > 0, 1).astype(int))
        spans = zip(
            np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True
        )
        for a, b in spans:
            throws = np.linalg.norm(np.diff(ball[:, n], axis=0), axis=1) > 0.3
            if a < 3 or b + 1 >= len(share) or throws[a - 3 : b + 1].any():
                continue
            before = (ball[a - 1, n] - ball[a - 2, n]) / dt - 0.5 * dt * down
            after = (ball[b, n] - ball[b - 1, n]) / dt + 0.5 * dt * down
            lost = np.linalg.norm(after - before + (b - a) * dt * down)
            impulse = recordings[0].numbers["impulse"][a:b, n].sum()
            compared.append((impulse, lost))
    impulse, lost = np.array(compared).T
    assert (lost > 0.5).sum() >= 3  # the others are glances
    np.testing.assert_allclose(np.median(impulse / lost), 1.0, atol=0.1)


def test_same_policy_under_two_names_gives_the_same_rows(plan, push, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for name in ("policy.npz", "config.json"):
        shutil.copy(push / name, other / name)
    twice = report.prepare(
        [push, other], EPISODES, [0.16], 3, SECONDS, None, lambda text: None
    )
    assert len({id(player) for player in twice.players.values()}) == 1
    assert [run.name for run, _ in twice.conditions] == [str(push), str(other)]
    # The same environment, whose program is there already.
    (player,) = plan.players.values()
    shared = dataclasses.replace(twice, players=dict.fromkeys(twice.players, player))
    both = report.execute(shared, lambda done, total: None)
    mine, theirs = both.rows[:EPISODES], both.rows[EPISODES:]
    for one, another in zip(mine, theirs, strict=True):
        assert (one["run"], another["run"]) == (str(push), str(other))
        np.testing.assert_equal(one | {"run": ""}, another | {"run": ""})
    (comparison,) = both.comparisons
    assert comparison.ratio["torque/rms"].value == 1.0
    assert {x.value for x in comparison.difference.values()} <= {0.0} | {np.nan}


def test_report_has_a_row_an_episode_and_its_arm(found, push):
    arms = [(c.alpha, c.u_on) for c in found.conditions]
    assert arms == [(0.0, True), (0.16, True), (0.16, False)]
    episodes = [(row["alpha"], row["u_on"], row["episode"]) for row in found.rows]
    assert episodes == [(*arm, n) for arm in arms for n in range(EPISODES)]
    moved = [found.summary[i]["u/joints_max"].value for i in range(3)]
    assert moved[0] == moved[2] == 0.0 and moved[1] > 1e-5
    assert all(("u_on" in c and c["peak"] > 0.0) for c in found.contacts)
    assert found.clock == "since_throw"
    # The parameters that the run was trained with, not the task's own.
    assert found.parameters == {str(push): asdict(Push(speed=(2.0, 3.5)))}
    assert "task/speed/mean" in found.rows[0]


def test_summary_is_of_the_rows(found):
    peaks = np.array([row["contact/peak"] for row in found.rows])
    for i, part in enumerate(np.split(peaks, 3)):
        mean = found.summary[i]["contact/peak"]
        assert mean.value == pytest.approx(np.nanmean(part))
        assert np.nanmin(part) <= mean.low < mean.value < mean.high <= np.nanmax(part)
    listed = [c["peak"] for c in found.contacts if c["alpha"] == 0.0]
    assert found.summary[0]["contact/peak_max"].value == max(listed)
    assert found.summary[0]["broken"].value == 0.0
    assert found.summary[0]["style/frechet"].value > 0.0


def test_effect_of_compliance_is_the_difference_of_the_differences(found):
    level, control, effect = found.comparisons
    for comparison, pair in ((level, (1, 0)), (control, (2, 0)), (effect, (1, 2))):
        assert (comparison.condition, comparison.baseline) == pair
    for name in ("torque/rms", "energy", "u/joints"):
        of = [c.difference[name].value for c in (level, control, effect)]
        assert of[2] == pytest.approx(of[0] - of[1], abs=1e-9)
    assert effect.difference["u/joints"].value > 0.0


def test_control_arms_are_played_where_levels_are_compared(push):
    run = runs.find_run(push)

    def played(levels: list[float], control: bool) -> list[tuple[float, bool, float]]:
        found = report._conditions([(run, levels)], control)
        return [(c.alpha, c.u_on, c.level) for _, c in found]

    three = [(0.0, True, 0.0), (0.16, True, 0.16), (0.16, False, 0.0)]
    assert played([0.0, 0.16], True) == three
    assert played([0.0, 0.16], False) == three[:2]
    assert played([0.16], True) == three[1:2]


def test_control_arm_is_drawn_in_its_levels_colour_and_dashed(found):
    level, control = (show._line(found, i) for i in (1, 2))
    assert control == level | {"linestyle": "--"}
    assert show._line(found, 0)["color"] != level["color"]


def test_json_and_figure_are_written_and_the_table_is_printed(
    found, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(report, "prepare", lambda *args: None)
    monkeypatch.setattr(report, "execute", lambda plan, progress: found)
    paths = {name: tmp_path / "new" / name for name in ("a.json", "a.png")}
    argv = ["RUN", "--json", str(paths["a.json"]), "--figure", str(paths["a.png"])]
    assert command.main(argv) == 0
    text = capsys.readouterr().out
    level, control = "alpha 0.16 / alpha 0", "alpha 0.16, u off / alpha 0"
    for part in (level, control, "alpha 0.16: u on / u off"):
        assert text.count(part) == 1
    assert text.count("contact/peak (N)") == text.count("survived (s)") == 2
    assert text.count("contact/peak_max (N)") == 1
    lines = text.splitlines()
    rows = [next(i for i, x in enumerate(lines) if n in x) for n in FIRST_ROWS]
    assert rows == sorted(rows)
    data = json.loads(paths["a.json"].read_text(), parse_constant=pytest.fail)
    assert [row["u_on"] for row in data["rows"]].count(False) == EPISODES
    assert data["summary"][0]["fell"].keys() == {"value", "low", "high"}
    picture = imread(paths["a.png"])
    assert picture.shape[0] > 500 and picture[..., :3].std() > 0.05


def test_alpha_is_where_the_policy_observes_it(plan):
    player = plan.players[plan.conditions[0][0].name]
    count, split = player._width(2), NamedSharding(player._mesh, PartitionSpec("env"))
    # One key for all: what differs is alpha.
    keys = jnp.repeat(jax.random.key(0)[None], count)
    level = np.full(count, 0.25, np.float32)
    level[1] = 0.75
    low, high, *_ = np.asarray(player._reset(*jax.device_put((keys, level), split)).obs)
    (entry,) = np.flatnonzero(low != high)
    assert entry == ALPHA_ENTRY and low[entry] == 0.25 and high[entry] == 0.75


def test_policy_is_told_an_alpha_it_knows(push):
    said: list[str] = []
    known = _trained_at(runs.find_run(push), 0.16)
    assert known.alphas == (0.16, 0.16)
    assert report._levels(known, None, said.append) == [0.16]
    assert not said
    assert report._levels(known, [0.0, 0.16], said.append) == [0.0, 0.16]
    assert "trained at alpha 0.16: at 0 its policy" in said[0]


def test_task_with_other_parameters_takes_the_place_of_the_configured_one(push):
    environment = runs.make_environment(runs.find_run(push), Push(mass=4.0))
    model = environment.scene.model
    assert model.body("ball").mass[0] == pytest.approx(4.0)
    assert environment.config.episode_seconds > 3600.0


def _damaged(push: Path, folder: Path) -> Path:
    (folder / "config.json").write_text((push / "config.json").read_text())
    (folder / "policy.npz").write_bytes((push / "policy.npz").read_bytes()[:900])
    return folder


@pytest.mark.parametrize(
    ("argv", "parts"),
    [
        ([], ["RUN_DIR"]),
        (["/none/here"], ["/none/here is not a run directory"]),
        (["{push}", "--episodes", "0"], ["episodes must be 1 or more, got 0"]),
        (["{push}", "--episodes", "many"], ["--episodes", "many"]),
        (["{push}", "--alpha", "1.5"], ["alpha must be in [0, 0.9], got 1.5"]),
        (["{push}", "--alpha", "0.1", "0.1"], ["alpha must be different"]),
        (["{push}", "--seconds", "0"], ["seconds must be in", "got 0.0"]),
        (["{push}", "--seed", "-1"], ["seed must be", "-1"]),
        (["{push}", "--figure", "a.doc"], ["'doc'", "png"]),
        (["{push}", "--json", "{empty}"], ["empty is a directory, not a file"]),
        (["{push}", "{push}"], ["a run is given twice"]),
        (["{damaged}"], ["policy.npz is damaged"]),
        (["{empty}"], ["is not a run directory: no config.json"]),
        (["{other}"], ["task must be one of", "'fly'"]),
        (["{smaller}"], ["20 observations", "push has"]),
        (["{push}", "--bogus"], ["--bogus"]),
        (["{push}", "--drag", "--seconds", "3"], ["--seconds does nothing with --dr"]),
        (["backflip", "--drag"], ["a drag lasts 7 s", "the clip backflip"]),
    ],
)
def test_bad_input_is_one_line_and_status_two(argv, parts, push, tmp_path, capsys):
    made = {"push": push}
    for name in ("damaged", "empty", "other", "smaller"):
        made[name] = tmp_path / name
        made[name].mkdir()
    _damaged(push, made["damaged"])
    config = json.loads((push / "config.json").read_text())
    for name in ("other", "smaller"):
        shutil.copy(push / "policy.npz", made[name])
        changed = config | ({"task": "fly"} if name == "other" else {})
        (made[name] / "config.json").write_text(json.dumps(changed))
    with np.load(made["smaller"] / "policy.npz") as archive:
        arrays = dict(archive)
    arrays["params.layers.0.kernel"] = arrays["params.layers.0.kernel"][:20]
    np.savez(made["smaller"] / "policy.npz", **arrays)
    assert command.main([part.format(**made) for part in argv]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    for part in parts:
        assert part in lines[0]


def test_error_nobody_foresaw_is_one_line_with_details_in_a_file(
    monkeypatch, capsys, tmp_path
):
    def fail(plan: object, progress: object) -> None:
        raise ZeroDivisionError("one over zero\nand more")

    monkeypatch.setattr(report, "prepare", lambda *args: None)
    monkeypatch.setattr(report, "execute", fail)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    assert command.main(["RUN"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "ZeroDivisionError: one over zero" in line
    (log,) = tmp_path.iterdir()
    assert str(log) in line and "and more" in log.read_text()
