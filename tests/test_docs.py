"""The code in the documentation does what the documentation says."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import physics, tasks
from dcc_jax.config import make_config
from dcc_jax.training import loop

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
COMMANDS = re.findall(
    r"^python -m dcc_jax\.(.+)$", (ROOT / "README.md").read_text(), re.MULTILINE
)


class Understood(BaseException):
    """In place of carrying out a command."""


def test_readme_has_its_commands():
    assert {command.split()[0] for command in COMMANDS} == {
        "train",
        "evaluate",
        "render",
        "training.curves",
        "motion",
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_command_of_the_readme_is_understood(command, monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def understood(self, *args, **kwargs):
        parse(self, *args, **kwargs)
        raise Understood

    def prepared(*args, **kwargs):
        raise Understood

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", understood)
    monkeypatch.setattr(loop, "prepare", prepared)
    name, *arguments = shlex.split(command, comments=True)
    package = "dcc_jax." + name
    if (ROOT / "src/dcc_jax" / name).is_dir():
        package += ".__main__"
    with pytest.raises((Understood, SystemExit)) as caught:
        importlib.import_module(package).main(arguments)
    assert caught.type is Understood or caught.value.code == 0


def test_task_of_the_walkthrough_pulls_at_the_hand_as_it_says(tmp_path, monkeypatch):
    """Its environment traces, and the force is the rubber band's, at the hand."""
    code = re.search(r"```python\n(.*?)```", (DOCS / "tasks.md").read_text(), re.S)
    assert code is not None
    assert len(code[1].splitlines()) <= 50, "it claims to be short"
    (tmp_path / "rubber_band.py").write_text(code[1])
    monkeypatch.syspath_prepend(tmp_path)
    rubber_band = importlib.import_module("rubber_band")
    task = rubber_band.RubberBand()
    environment = tasks.make_environment(task, make_config("push", "smoke").env)
    key = jax.random.key(0)
    state = jax.eval_shape(environment.reset, key)
    action = jnp.zeros(environment.action_size)
    after = jax.eval_shape(environment.step, key, state, action)
    assert after.obs.shape == (environment.observation_size,)

    scene = environment.scene
    qpos = jnp.asarray(scene.model.qpos0, jnp.float32)
    body = physics.initial_state(scene, qpos, jnp.zeros(scene.model.nv))

    @jax.jit
    def pulled(body: physics.State):
        kin = physics.kinematics(scene, body)
        hand = kin.body_pos[scene.body("left_hand")]
        state = rubber_band.State(anchor=hand + jnp.array([0.0, 0.5, 0.0]))
        _, forces = task.forces(scene, state, kin, None, action)
        return forces.force_w, task.applied(scene, state, kin, jnp.zeros(()))

    force, qfrc = pulled(body)
    np.testing.assert_allclose(force, [[0.0, 30.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose(qfrc[:3], force[0], atol=1e-3)
