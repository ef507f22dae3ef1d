"""What the learner asks of an environment.

Letters: O observation, F body features, C condition.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax

Array = jax.Array


class EnvState(Protocol):
    """What the learner reads of the state of one environment."""

    @property
    def obs(self) -> Array: ...  # [O]
    @property
    def features(self) -> Array: ...  # [F] s'
    @property
    def previous_features(self) -> Array: ...  # [F] s, of the same episode
    @property
    def condition(self) -> Array: ...  # [C]
    @property
    def r_q(self) -> Array: ...  # [] read where the environment tracks
    @property
    def r_p(self) -> Array: ...  # []
    @property
    def r_task(self) -> Array: ...  # []
    @property
    def terminated(self) -> Array: ...  # [] bool
    @property
    def truncated(self) -> Array: ...  # [] bool
    @property
    def nan(self) -> Array: ...  # [] bool
    @property
    def metrics(self) -> Any: ...  # struct of [] floats


class Environment(Protocol):
    """One environment: static, pure functions, no batch axis."""

    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    @property
    def feature_size(self) -> int: ...
    @property
    def condition_size(self) -> int: ...
    @property
    def has_task_reward(self) -> bool: ...
    @property
    def tracks_reference(self) -> bool: ...  # r_q is its own, not the discriminator's

    def reset(self, key: Array, alpha: Array | None = None) -> Any: ...
    def step(self, key: Array, state: Any, action: Array) -> Any: ...
    def expert_pairs(self, key: Array, spans: Array) -> tuple[Array, Array, Array]: ...
    def expert_action(self, state: Any) -> Array: ...
    def style_coordinates(self, s: Array, s_next: Array) -> Array: ...
