"""A training that begins with the policy of another one."""

from __future__ import annotations

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from dcc_jax import sweep
from dcc_jax.learn import learner
from dcc_jax.training import checkpoint, loop
from toy import Toy
from toy_run import toy_config


def _config(updates: int, start_from: str, **of_train):
    config = toy_config(updates)
    train = dataclasses.replace(config.train, start_from=start_from, **of_train)
    return dataclasses.replace(config, train=train)


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> str:
    run_dir = tmp_path_factory.mktemp("runs") / "first"
    loop.train(toy_config(3), run_dir=run_dir, environment=Toy(), quiet=True)
    return str(run_dir)


def _same(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_it_begins_with_that_policy_and_a_fresh_optimiser(first, tmp_path):
    config = _config(1, first, warm_start_steps=5)
    run = loop.prepare(config, tmp_path / "second", environment=Toy())
    assert run.start is not None
    _same(run.start, checkpoint.load_policy(first))
    make = learner.make_init(Toy(), config, run.mesh, start=run.start)
    state = make(jax.random.key(0), None)
    _same(state.agent.policy.params, run.start.params)
    _same(state.obs_normalizer, run.start.normalizer)
    cold = learner.make_init(Toy(), toy_config(1), run.mesh)(jax.random.key(0), None)
    _same(state.agent.policy.opt_state, cold.agent.policy.opt_state)


def test_run_goes_on_when_its_start_is_gone(first, tmp_path):
    origin = tmp_path / "origin"
    shutil.copytree(first, origin)
    run_dir = tmp_path / "second"
    config = _config(2, str(origin))
    loop.train(config, run_dir=run_dir, environment=Toy(), quiet=True)
    shutil.rmtree(origin)
    result = loop.train(
        _config(4, str(origin)),
        run_dir=run_dir,
        resume=True,
        environment=Toy(),
        quiet=True,
    )
    assert result.finished and len(result.metrics) == 4


def test_every_run_of_a_sweep_begins_with_it(first, tmp_path):
    with jax.debug_key_reuse(False):  # as in test_sweep.py
        result = sweep(
            _config(1, first),
            seeds=(0, 1),
            run_dir=tmp_path / "sweep",
            environment=Toy(),
            quiet=True,
        )
    begun = checkpoint.load_policy(first)
    for policy in result.policies.values():
        _same(policy.params, begun.params)


def test_policy_waits_for_the_value_function(first, tmp_path):
    begun = checkpoint.load_policy(first)

    def after(updates: int):
        run_dir = tmp_path / f"{updates}"
        config = _config(updates, first, policy_waits=2)
        loop.train(config, run_dir=run_dir, environment=Toy(), quiet=True)
        return checkpoint.load_policy(run_dir).params

    _same(after(2), begun.params)
    with pytest.raises(AssertionError):
        _same(after(3), begun.params)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nobody", "nobody is not a run directory; policies that ship: .*push"),
        ("push", "train.start_from push has .* observations, .*; this training"),
    ],
)
def test_policy_that_does_not_fit_is_one_line(name, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        loop.prepare(_config(1, name), tmp_path / "run", environment=Toy())
    assert not (tmp_path / "run").exists()
