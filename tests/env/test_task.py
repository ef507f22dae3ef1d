"""What a task gets from the defaults of `Task`."""

import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.character import asset_path
from dcc_jax.env.task import RootTarget, Task
from dcc_jax.motion.clip import load_clip
from dcc_jax.motion.reference import make_references

SPEEDS = {"stand": 0.0, "balance": 0.0, "walk_cycle": 1.2, "run_cycle": 3.0}  # m/s


def test_root_target_of_a_walk_and_a_run_goes_on_and_of_a_stand_stays():
    clips = [load_clip(asset_path(f"motions/{name}.npz")) for name in SPEEDS]
    references = make_references(clips)
    for clip, speed in enumerate(SPEEDS.values()):
        start = references.state_at(clip, 0.2)
        at_reset = RootTarget(start.qpos[:2], start.travel)
        target = Task().root_target(None, None, at_reset, jnp.array(4.0))
        assert np.linalg.norm(target.velocity) == pytest.approx(speed, abs=0.05)
        away = np.linalg.norm(target.position - start.qpos[:2])
        assert away == pytest.approx(4.0 * speed, abs=0.2)
