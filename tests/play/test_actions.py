"""What a person may have a task do."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dcc_jax.config import make_config
from dcc_jax.play import actions
from dcc_jax.tasks import TASKS, make_environment, make_task
from dcc_jax.tasks.backflip import Backflip
from dcc_jax.tasks.push import Push, PushState
from dcc_jax.tasks.sustained_push import SustainedPush
from dcc_jax.tasks.trampoline import Trampoline


@pytest.mark.parametrize("name", TASKS)
def test_what_a_task_offers_changes_numbers_of_its_state(name):
    task = make_task(name)
    environment = make_environment(task, make_config(name, "smoke").env)
    state = jax.eval_shape(environment.reset, jax.random.key(0)).task
    state = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), state)
    for action in actions.of(task):
        value = action.low
        changed = action.apply(task, state, value)
        assert jax.tree.structure(changed) == jax.tree.structure(state)
        pairs = zip(jax.tree.leaves(changed), jax.tree.leaves(state), strict=True)
        assert any(np.any(a != b) for a, b in pairs)
        for a, b in zip(jax.tree.leaves(changed), jax.tree.leaves(state), strict=True):
            assert (a.dtype, a.shape) == (b.dtype, b.shape)


def test_what_has_a_schedule_waits_and_what_has_begun_goes_on():
    task = Push()
    assert task.event is not None and Backflip().event == Trampoline().event
    later = actions.waiting(task, PushState(np.float32(0.4)))
    assert later.next_throw == pytest.approx(task.interval)
    begun = PushState(np.float32(-0.02))
    assert actions.waiting(task, begun) is begun


def test_leader_goes_where_it_is_told_and_wants_nothing_else():
    speed, turn = (a for a in actions.of(SustainedPush()) if a.is_slider)
    assert (speed.low, speed.high) == (0.0, 3.0)
    assert turn.high == pytest.approx(0.5)


def test_door_has_a_width():
    assert set(make_task("door").adjustable) == {"width"}
    assert not make_task("push").adjustable
