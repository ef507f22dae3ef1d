"""The figures of `experiments`: what is drawn and told, from rows made by hand."""

from __future__ import annotations

import argparse
import importlib
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from matplotlib.image import imread

import dcc_jax
from dcc_jax.character import asset_path
from dcc_jax.env.pairs import SEEN_SIZE
from dcc_jax.evaluate import bootstrap, compare
from dcc_jax.evaluate.compare import Condition, Part
from dcc_jax.learn import discriminator, networks
from dcc_jax.motion import planner
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.paths import Gaits
from dcc_jax.motion.reference import make_references
from dcc_jax.tasks import make_environment

ROOT = Path(__file__).resolve().parents[1]
ARMS = [Condition("a", 0.0), Condition("a", 0.16), Condition("a", 0.16, u_on=False)]


@pytest.fixture(autouse=True)
def _found(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")


def _rows(**metrics: tuple[float, float, float]) -> list[dict]:
    """Eight episodes; a metric has a value an arm, and the episode number on top."""
    return [
        {**asdict(arm), "episode": n, **{k: v[i] + n for k, v in metrics.items()}}
        for i, arm in enumerate(ARMS)
        for n in range(8)
    ]


def test_effects_are_of_u_of_being_told_and_of_compliance_alone():
    paired = importlib.import_module("paired")
    found = paired.effects(_rows(force=(10.0, 9.0, 8.5)), "force")
    values = {p["effect"]: p["value"] for p in found}
    assert values == {"with u": -1.0, "told alpha, u off": -1.5, "compliance": 0.5}
    assert all(p["low"] == p["value"] == p["high"] for p in found)


def test_arms_are_those_that_an_evaluation_plays():
    paired = importlib.import_module("paired")
    known = [{"alpha": c.alpha, "u_on": c.u_on} for c in ARMS]
    assert paired.arms((0.0, 0.16), control=True) == known
    assert paired.arms((0.0, 0.16), control=False) == known[:2]
    assert paired.arms_of(_rows()) == known


@pytest.mark.parametrize("name", ["fig4_levels", "fig5_trampoline", "fig6_door"])
def test_control_arm_is_played_and_can_be_left_out(name):
    paired = importlib.import_module("paired")
    options = paired.parser("What.", name, (0.0, 0.16))
    assert options.parse_args(["push"]).control
    assert not options.parse_args(["push", "--no-control"]).control


def test_ratios_of_figure_4_have_the_control_arm(tmp_path):
    fig4 = importlib.import_module("fig4_levels")
    names = dict.fromkeys([*fig4.RATIOS, "range"], (10.0, 5.0, 10.0))
    rows = [row | {"fell": row["episode"] < 2} for row in _rows(**names)]
    points = fig4.measured(rows)
    ratios = {
        (p["alpha"], p["u_on"]): p["value"]
        for p in points
        if p["name"] == "contact/peak" and p["run"] is None
    }
    assert ratios[0.0, True] == ratios[0.16, False] == 1.0 != ratios[0.16, True]
    assert {p["value"] for p in points if p["name"] == "fell"} == {0.25}
    fig4.draw(points, tmp_path / "a.png")
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05


def test_curves_of_figure_5_are_of_every_arm(tmp_path):
    fig5 = importlib.import_module("fig5_trampoline")
    curve = [[0.0, 0.1], [1.0, 2.0], [0.1, 0.1]]
    report = SimpleNamespace(
        conditions=ARMS,
        curves=[
            {name: (np.array(curve) + i).tolist() for name in fig5.CURVES}
            for i, _ in enumerate(ARMS)
        ],
        rows=_rows(**dict.fromkeys(fig5.BARS, (1.0, 2.0, 3.0))),
    )
    points = fig5.measured(report)
    means = [p["mean"] for p in points if p["name"] == "energy"]
    assert means == [[1.0, 2.0], [2.0, 3.0], [3.0, 4.0]]
    fig5.draw(points, tmp_path / "a.png")
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05


def test_figure_6_compares_the_arms_at_every_width(tmp_path, monkeypatch):
    fig6 = importlib.import_module("fig6_door")
    names = dict.fromkeys(fig6.PANELS, (10.0, 9.0, 8.0))
    rows = [row | {fig6.OPEN: row["episode"] < 4} for row in _rows(**names)]
    report = SimpleNamespace(rows=rows)
    asked = []

    def evaluated(options, runs, task):
        asked.append(task.width)
        return report

    monkeypatch.setattr(fig6.paired, "evaluated", evaluated)
    options = argparse.Namespace(runs=[Path("door")], widths=[1.0, 1.5])
    points = fig6.measured(fig6.measure(options))
    assert asked == [1.0, 1.5]
    assert len(points) == 2 * len(fig6.PANELS) * len(ARMS)
    assert {p["value"] for p in points if p["name"] == fig6.OPEN} == {0.5}
    fig6.draw(points, tmp_path / "a.png")
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05


def test_momenta_of_a_match_are_drawn_to_one_scale(tmp_path):
    match = importlib.import_module("chicken_match")
    rows = [
        {**arm, "match": n, "impulse": 9.0, "driven_heavy": -0.03, "driven_light": 0.08}
        | {"momentum_before": 10.0 + n, "momentum_after": 9.0 + n}
        for arm in match.paired.arms((0.0, 0.16), control=True)
        for n in range(8)
    ]
    points = []
    for arm in match.paired.arms_of(rows):
        own = [row for row in rows if arm.items() <= row.items()]
        points += match.measured(arm, np.repeat([0, 2], 4), own)
    value = {p["name"]: p["value"] for p in points}
    assert value["wins_heavy"] == 0.5 and value["momentum_change"] == -1.0
    assert value["driven_light_to_heavy"] == pytest.approx(0.08 / 0.03)
    _, axes = match.paired.panels([4.0])
    match._draw_momenta(axes, rows)
    assert axes.get_aspect() == 1.0
    match.draw(points, rows, tmp_path / "a.png")
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05


def test_table_has_the_arms_and_what_compliance_alone_does():
    table = importlib.import_module("control_table")
    rows = _rows(force=(10.0, 9.0, 8.5))
    parts = [
        Part(
            arm,
            [{"force": r["force"]} for r in rows[8 * i : 8 * i + 8]],
            [],
            {},
            {},
            [],
        )
        for i, arm in enumerate(ARMS)
    ]
    draws = bootstrap.draws(8)
    report = {
        "conditions": [asdict(arm) for arm in ARMS],
        "rows": rows,
        "summary": [
            {"force": asdict(bootstrap.mean(np.full(8, x), draws))}
            for x in (10.0, 9.0, 8.5)
        ],
        "comparisons": [asdict(c) for c in compare.comparisons(parts, draws)],
    }
    lines = (table.Line("force", "force (mN)", 1e3, 0), table.Line("none", "nothing"))
    head, _, row = table.table(report, lines).splitlines()
    assert head.split(" | ")[3:] == ["alpha 0.16, u off", "u alone, 0.16 |"]
    values = [cell.split()[0] for cell in row.split(" | ")[1:]]
    assert values == ["10000", "9000", "8500", "+500"]


def test_survivable_impulse_is_where_half_of_them_fall():
    survival = importlib.import_module("survivable_impulse")
    rng = np.random.default_rng(0)
    impulse = rng.uniform(0.1, 2.5, 4000)
    chance = 1.0 / (1.0 + np.exp(-6.0 * (np.log(impulse) - np.log(0.8))))
    fell = rng.uniform(size=4000) < chance
    assert survival.survivable(impulse, fell) == pytest.approx(0.8, rel=0.05)


def test_sectors_of_the_survivable_impulse_are_those_of_the_push():
    survival = importlib.import_module("survivable_impulse")
    rng = np.random.default_rng(0)
    angle, impulse = rng.uniform(-np.pi, np.pi, 800), rng.uniform(0.1, 2.5, 800)
    limit = np.where(np.abs(angle) < np.pi / 8, 1.5, 0.5)  # stronger to the front
    rows = [
        {
            "alpha": 0.0,
            "u_on": True,
            "task/angle/max": a,
            "task/impulse/max": i,
            "fell": i > most,
        }
        for a, i, most in zip(angle, impulse, limit, strict=True)
    ]
    points = survival.by_sector(rows, {"alpha": 0.0, "u_on": True})
    assert [p["value"] for p in points] == pytest.approx([1.5] + 7 * [0.5], rel=0.1)


def test_table_of_soft_contacts_has_the_effect_of_u_alone():
    soft = importlib.import_module("soft_contact")
    rows = _rows(**{"force/max": (100.0, 60.0, 90.0), "fell": (0.0, 0.0, 0.0)})
    rows = [row | {"task/spring/final": 0.0, "fell": False} for row in rows]
    (line,) = soft.lines(rows, soft.SPRINGS[:1])
    cells = [cell.split(" [")[0].strip() for cell in line.strip("|").split("|")]
    expected = [
        "pull, 5 N/m",
        "0.16",
        "104 N",
        "-39%",
        "-10%",
        "-29%",
        "0%",
        "0%",
        "0%",
    ]
    assert cells == expected


def test_steps_of_feet_that_take_turns_and_of_one_that_drags():
    speeds = importlib.import_module("locomotion_speeds")
    time = np.arange(0.0, 4.0, 1 / 30)
    walking = speeds._steps(0.3 * np.sin(2 * np.pi * time))
    assert walking == [1, -1, 1, -1, 1, -1, 1, -1]
    assert speeds._alternate(walking) == 1.0
    limping = speeds._steps(0.3 * np.abs(np.sin(np.pi * time)))
    assert limping == [1, 1, 1, 1] and speeds._alternate(limping) == 0.0
    assert speeds._steps(np.full(50, 0.02)) == []


def test_hops_are_counted_by_when_they_leave_and_are_as_high_as_the_clip():
    speeds = importlib.import_module("hop_speeds")
    clip = load_clip(asset_path("motions/hop_cycle.npz"))
    up = speeds.airborne(clip.qpos)
    assert 0.2 < up.mean() < 0.35
    twice = np.concatenate([up[:-1], up])
    assert speeds.cadence(twice) == pytest.approx(5 / 2.4, rel=0.03)
    assert speeds.cadence(np.zeros(60, bool)) == 0.0


def test_error_of_a_speed_is_of_means_over_a_second():
    speeds = importlib.import_module("locomotion_speeds")
    time = np.arange(0.0, 5.0, 1 / 30)[:, None]
    along = 2.0 + 0.4 * np.sin(2 * np.pi * 2.0 * time)  # rocks twice a second
    assert speeds._error(along, 2.0) < 1e-2
    assert speeds._error(along + 0.3, 2.0) == pytest.approx(0.3, rel=1e-3)


def test_steady_strides_of_the_planner_are_the_clips():
    by_speed = importlib.import_module("style_by_speed")
    config = dcc_jax.make_config("locomotion", preset="smoke")
    environment = make_environment(config.task, config.env)
    clips = [load_clip(asset_path(f"motions/{name}.npz")) for name in planner.LOOPS]
    gaits = Gaits(speeds=(1.2,), turn_rate=0.0)
    loops, key = make_references(clips), jax.random.key(0)
    seen = by_speed.planned(gaits, loops, environment, (30, 4), key)
    assert np.nanmax(by_speed.distances(environment, seen)) < 20.0
    points, speed, up = seen
    np.testing.assert_allclose(speed, 1.2, atol=1e-3)
    assert by_speed.distances(environment, (0.9 * points, speed, up)).min() > 25.0
    fallen = (points, speed, up.at[10:].set(False))
    assert np.isnan(by_speed.distances(environment, fallen)[10:]).all()


def test_parts_of_a_score_add_up_to_it():
    """Of a discriminator with random weights, and of pairs at random."""
    sees = importlib.import_module("what_it_sees")
    keys = jax.random.split(jax.random.key(0), 3)
    net = networks.init_mlp(keys[0], (2 * SEEN_SIZE, 32, 32, 1), activation="tanh")
    policy = 0.2 * jax.random.normal(keys[1], (40, 2 * SEEN_SIZE))
    clips = 0.1 * jax.random.normal(keys[2], (60, 2 * SEEN_SIZE))
    state = SimpleNamespace(disc=SimpleNamespace(params=net))
    found = sees.parts(state, policy, clips)
    apart = np.linalg.norm(np.asarray(policy)[:, None] - np.asarray(clips), axis=-1)
    near = clips[apart.argmin(axis=1)]
    expected = np.mean(
        discriminator.score(net, near) - discriminator.score(net, policy)
    )
    assert sum(found.values()) == pytest.approx(float(expected), rel=1e-3)
    assert list(found) == [*sees.KINDS, "sliding soles"]
    # Numbers of one kind alone are that kind's.
    columns = np.zeros((2, SEEN_SIZE), bool)
    columns[:, :270] = np.tile(np.arange(18) // 6 == 1, 15)
    alone = np.where(columns.ravel(), np.asarray(policy), np.asarray(clips)[0])
    only = sees.parts(state, jax.numpy.asarray(alone), clips[:1])
    assert only["columns"] != 0.0
    assert all(value == 0.0 for name, value in only.items() if name != "columns")
