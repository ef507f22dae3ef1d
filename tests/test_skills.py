"""Every task through the three commands: train for a moment, evaluate, render."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import smoke
from dcc_jax.evaluate import report as report_module
from dcc_jax.render import film
from dcc_jax.tasks import TASKS

# The package shows the functions of those names; these tests want the modules.
evaluate = importlib.import_module("dcc_jax.evaluate.__main__")
render = importlib.import_module("dcc_jax.render.__main__")


BY_DEFAULT = ("push", "door")
"""One taught by the discriminator and one by tracking; `make test-all` has the others:
each compiles three programs of its own."""


def _marks(task: str) -> list[pytest.MarkDecorator]:
    group = pytest.mark.xdist_group(task)
    return [group] if task in BY_DEFAULT else [group, pytest.mark.slow]


@pytest.mark.parametrize(
    "task", [pytest.param(task, marks=_marks(task)) for task in TASKS]
)
def test_task_trains_is_evaluated_and_drawn(
    task: str,
    smoke_run: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_dir = smoke_run(task)
    # What plays and draws is one program.
    monkeypatch.setattr(report_module, "Player", smoke.player)
    monkeypatch.setattr(film, "Player", smoke.player)
    rows = [json.loads(line) for line in (run_dir / "metrics.jsonl").open()]
    assert len(rows) == 2
    for row in rows:
        assert row["nan_count"] == 0
        assert 0.0 < row["reward/total"] <= 1.0
    table = tmp_path / "rows.json"
    arguments = [
        str(run_dir),
        "--episodes",
        "4",
        "--seconds",
        "1",
        "--alpha",
        "0",
        "0.16",
    ]
    assert evaluate.main([*arguments, "--json", str(table)]) == 0
    report = json.loads(table.read_text())
    arms = [(arm["alpha"], arm["u_on"]) for arm in report["conditions"]]
    assert arms == [(0.0, True), (0.16, True), (0.16, False)]
    assert len(report["rows"]) == 4 * len(arms)
    assert [arm["broken"]["value"] for arm in report["summary"]] == [0.0] * len(arms)
    picture = tmp_path / "strip.png"
    strip = ["--strip", str(picture), "--seconds", "1", "--seed", "3"]
    assert render.main([str(run_dir), *strip]) == 0
    page = imread(picture)[..., :3]
    frames = page.reshape(3, page.shape[0] // 3, 4, -1, 3).swapaxes(1, 2)
    assert np.abs(frames[0, 0] - frames[1, 0]).mean() > 1e-3, "nothing moves"
