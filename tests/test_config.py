"""The configuration: presets, json in and out."""

import dataclasses
import json

import numpy as np
import pytest

from dcc_jax import config
from dcc_jax.learn import learner
from dcc_jax.tasks import TASKS
from dcc_jax.tasks.door import Door


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
    assert made.disc.gradient_penalty == 10.0
    assert made.disc.instance_noise == 0.0
    assert made.env.physics_rate == 600


def test_settings_of_a_task_count_with_cpu_and_gpu_alone():
    sigmas = {
        p: config.make_config("ball", p).ppo.sigma_degrees for p in config.PRESETS
    }
    assert sigmas == {"smoke": 6.0, "cpu": 3.0, "gpu": 3.0, "paper": 6.0}
    assert config.make_config("door").ppo.sigma_degrees == 6.0


@pytest.mark.parametrize("preset", config.PRESETS)
@pytest.mark.parametrize("task", TASKS)
def test_configuration_of_every_task_survives_json(task, preset):
    made = config.make_config(task, preset)
    assert config.from_json(config.to_json(made)) == made


def test_parameters_of_the_task_are_part_of_the_configuration():
    made = config.make_config(Door(width=1.3))
    assert made.task == Door(width=1.3)
    written = json.loads(config.to_json(made))["task"]
    assert written == {
        "name": "door",
        "width": 1.3,
        "density": 12.0,
        "damping": 10.0,
        "reach": 0.05,
    }
    assert config.from_json(config.to_json(made)) == made


def test_nested_parameters_of_a_task_survive_json():
    made = config.make_config("hand-in-hand").with_({"task.gaits.speeds": [0, 1]})
    assert made.task.gaits.speeds == (0.0, 1.0)  # pyright: ignore
    assert config.from_json(config.to_json(made)) == made


def test_task_of_an_old_run_is_its_name_alone():
    data = json.loads(config.to_json(config.make_config("door")))
    data["task"] = "door"
    assert config.from_json(json.dumps(data)) == config.make_config("door")


def test_class_of_a_task_makes_the_same_configuration_as_its_name():
    assert config.make_config(Door) == config.make_config("door")


def test_unknown_task_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match=r"one of push, .*, got 'nonsense'"):
        config.make_config("nonsense")
    with pytest.raises(ValueError, match="must be a Task, got 'door'"):
        config.Config(task="door")  # pyright: ignore


def test_changes_reach_into_sections_and_leave_the_rest():
    old = config.make_config("door")
    new = old.with_({"ppo.clip": 0.1, "task.width": 1.3, "seed": 4})
    assert new.task == Door(width=1.3) and new.seed == 4
    assert new.ppo == dataclasses.replace(old.ppo, clip=0.1)
    assert (new.env, new.disc, new.train) == (old.env, old.disc, old.train)
    assert old == config.make_config("door")


def test_changes_that_are_allowed_only_together_are_made_together():
    made = config.make_config("push").with_({"env.alpha": 0.0, "env.alpha_max": 0.1})
    made = made.with_({"env.alpha": 0.4, "env.alpha_max": 0.8})
    assert (made.env.alpha, made.env.alpha_max) == (0.4, 0.8)


def test_task_changes_before_its_parameters():
    made = config.make_config("push").with_({"task.width": 1.3, "task": "door"})
    assert made.task == Door(width=1.3)


def test_numbers_of_numpy_become_pythons_own():
    made = config.make_config("push").with_(
        {"seed": np.int64(3), "ppo.clip": np.float32(0.5), "ppo.hidden": [np.int32(8)]}
    )
    assert config.from_json(config.to_json(made)) == made


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("ppo.momentum", 0.9, r"unknown entry ppo\.momentum; ppo has hidden, "),
        ("bogus.clip", 0.9, r"unknown entry bogus\.clip; a configuration has task, "),
        ("seed.clip", 0.9, r"unknown entry seed\.clip"),
        ("task.widht", 1.3, r"unknown entry task\.widht; task has width, "),
        ("task.width", -1.0, "width must be positive, got -1.0"),
        ("task", "fly", "task must be one of .*, got 'fly'"),
        ("task", {"width": 1.3}, r"task\.name is missing"),
        ("ppo.clip", "high", r"ppo\.clip must be a number, got 'high'"),
        ("ppo.epochs", 1.5, r"ppo\.epochs must be a whole number, got 1\.5"),
        ("ppo.epochs", True, r"ppo\.epochs must be a whole number, got True"),
        ("ppo.hidden", 64, r"ppo\.hidden must be several values, got 64"),
        ("ppo.activation", "step", r"ppo\.activation must be one of relu, .*'step'"),
        ("env.alpha_max", "x", r"env\.alpha_max must be a number or none, got 'x'"),
        ("env", 3, r"env must be .*EnvConfig, got 3"),
        ("env.turn_arm", 0.0, r"env\.turn_arm must be positive, got 0\.0"),
        ("env.velocity_time", 0.0, r"env\.velocity_time must be positive, got 0\.0"),
        ("preset", "gpu", "preset .* cannot be changed"),
    ],
)
def test_change_that_makes_no_sense_is_named(name, value, said):
    with pytest.raises(ValueError, match=said):
        config.make_config("door").with_({name: value})


def test_unknown_preset_is_named_with_the_allowed_ones():
    with pytest.raises(ValueError, match="smoke, cpu, gpu, paper, got 'big'"):
        config.make_config("push", "big")


def test_value_of_another_type_in_json_is_named():
    data = json.loads(config.to_json(config.make_config("push")))
    data["train"]["num_envs"] = "many"
    with pytest.raises(ValueError, match=r"num_envs must be a whole number, got 'many"):
        config.from_json(json.dumps(data))


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


def test_differences_name_the_parameters_of_the_task():
    old = config.make_config("door")
    assert config.differences(old, old.with_({"task.width": 1.3})) == [
        ("task.width", 1.0, 1.3)
    ]
    other = old.with_({"task": "push"})
    assert config.differences(old, other)[0] == ("task", "door", "push")
