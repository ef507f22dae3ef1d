"""The configuration: presets, json in and out."""

import dataclasses
import json

import pytest

from dcc_jax import config
from dcc_jax.learn import learner
from dcc_jax.tasks import TASKS


@pytest.mark.parametrize("preset", config.PRESETS)
def test_preset_survives_json(preset):
    made = config.make_config("push", preset)
    assert config.from_json(config.to_json(made)) == made
    assert made.preset == preset


@pytest.mark.parametrize("preset", config.PRESETS)
@pytest.mark.parametrize("devices", [1, 2])
def test_preset_comes_out_even(preset, devices):
    learner.check_sizes(config.make_config("push", preset), devices)


def test_paper_preset_has_the_papers_numbers():
    made = config.make_config("trampoline", "paper")
    assert made.train.tuples_per_update == 2048
    assert made.ppo.minibatch_size == 128
    assert made.ppo.learning_rate == made.ppo.value_learning_rate == 1e-5
    assert made.ppo.target_kl is None
    assert made.ppo.hidden == made.disc.hidden == (256, 256, 256)
    assert made.ppo.discount == made.ppo.gae_lambda == 0.95
    assert made.ppo.sigma_degrees == 6.0
    assert made.disc.minibatch_size == 16
    assert made.disc.learning_rate == 1e-4
    assert made.env.physics_rate == 600


def test_settings_of_a_task_count_with_cpu_and_gpu_alone():
    sigmas = {
        p: config.make_config("ball", p).ppo.sigma_degrees for p in config.PRESETS
    }
    assert sigmas == {"smoke": 6.0, "cpu": 3.0, "gpu": 3.0, "paper": 6.0}
    assert config.make_config("push").ppo.sigma_degrees == 6.0


@pytest.mark.parametrize("task", TASKS)
def test_settings_of_every_task_name_what_there_is(task):
    made = config.make_config(task)
    assert config.from_json(config.to_json(made)) == made


def test_unknown_preset_is_named_with_the_allowed_ones():
    with pytest.raises(ValueError, match="smoke, cpu, gpu, paper, got 'big'"):
        config.make_config("push", "big")


def test_unknown_entry_of_json_is_named():
    data = json.loads(config.to_json(config.make_config("push")))
    data["ppo"]["momentum"] = 0.9
    with pytest.raises(ValueError, match=r"unknown entry ppo\.momentum"):
        config.from_json(json.dumps(data))


def test_value_out_of_range_in_json_is_named():
    data = json.loads(config.to_json(config.make_config("push")))
    data["train"]["num_envs"] = 0
    with pytest.raises(ValueError, match=r"train\.num_envs must be 1 or more, got 0"):
        config.from_json(json.dumps(data))


def test_directory_without_a_configuration_is_not_a_run(tmp_path):
    with pytest.raises(ValueError, match="is not a run directory"):
        config.load(tmp_path)


def test_configuration_cut_short_is_named(tmp_path):
    text = config.to_json(config.make_config("push"))
    (tmp_path / "config.json").write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match=r"config\.json: "):
        config.load(tmp_path)


def test_differences_name_the_entry():
    old = config.make_config("push")
    new = dataclasses.replace(old, ppo=dataclasses.replace(old.ppo, hidden=(64,)))
    assert config.differences(old, new) == [("ppo.hidden", (256, 256, 256), (64,))]
    assert config.differences(old, old) == []
