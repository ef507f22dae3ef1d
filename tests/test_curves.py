"""The picture of a run, and what it says where there is none."""

from __future__ import annotations

import json

import matplotlib.image
import pytest

from dcc_jax.training import curves


@pytest.fixture
def run_dir(tmp_path):
    directory = tmp_path / "run"
    directory.mkdir()
    rows = [
        {"update": i, "tuples": 1000 * i, "reward/total": 0.1 * i, "ppo/kl": None}
        for i in range(1, 6)
    ]
    lines = "".join(json.dumps(row) + "\n" for row in rows)
    (directory / "metrics.jsonl").write_text(lines)
    return directory


def test_command_draws_the_curves_into_the_run(run_dir, capsys):
    assert curves.main([str(run_dir)]) == 0
    assert capsys.readouterr().out.strip() == str(run_dir / "curves.png")
    picture = matplotlib.image.imread(run_dir / "curves.png")
    assert picture[..., :3].std() > 0.05, "there must be something to see"


def test_run_without_metrics_is_one_line_and_status_2(tmp_path, capsys):
    assert curves.main([str(tmp_path)]) == 2
    assert "holds no metrics.jsonl" in capsys.readouterr().err
