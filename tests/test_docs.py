"""The code in the documentation does what the documentation says."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax import __main__ as main
from dcc_jax import command, physics, tasks
from dcc_jax.config import make_config

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
COMMANDS = re.findall(
    r"^(?:dcc-jax|python -m dcc_jax)[ .](.+)$",
    (ROOT / "README.md").read_text(),
    re.MULTILINE,
)


class Understood(BaseException):
    """In place of what a command does with arguments that it understands."""


def test_readme_has_its_commands():
    names = {line.split()[0].removeprefix("training.") for line in COMMANDS}
    assert names == set(main.COMMANDS)


@pytest.mark.parametrize("line", COMMANDS)
def test_command_of_the_readme_is_understood(line, monkeypatch, capsys):
    """By the parser itself; `--help` ends there, everything else gets no farther."""
    run = command.run

    def without_work(program, argv, read, prepare):
        def understood(options):
            raise Understood

        return run(program, argv, read, understood)

    monkeypatch.setattr(command, "run", without_work)
    name, *arguments = shlex.split(line, comments=True)
    arguments = [name.removeprefix("training."), *arguments]
    if "--help" in arguments:
        assert main.main(arguments) == 0
        assert capsys.readouterr().out.startswith("usage: dcc-jax")
    else:
        with pytest.raises(Understood):
            main.main(arguments)


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
