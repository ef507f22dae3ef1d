"""Deep Compliant Control (Lee, Chang, Lee, SIGGRAPH 2022) in JAX and MuJoCo MJX.

Importing this package imports nothing else: jax and MuJoCo come with the first use of
a name below.
"""

from __future__ import annotations

import importlib
import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dcc_jax.config import make_config
    from dcc_jax.control.stiffness import stiffness
    from dcc_jax.evaluate.report import evaluate
    from dcc_jax.render.film import render
    from dcc_jax.tasks.registry import register_task
    from dcc_jax.training.loop import train
    from dcc_jax.training.sweep import sweep

__all__ = [
    "evaluate",
    "make_config",
    "register_task",
    "render",
    "stiffness",
    "sweep",
    "train",
]

_HOMES = {
    "make_config": "config",
    "train": "training.loop",
    "evaluate": "evaluate.report",
    "render": "render.film",
    "sweep": "training.sweep",
    "register_task": "tasks.registry",
    "stiffness": "control.stiffness",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'dcc_jax' has no attribute {name!r}")
    runtime = importlib.import_module("dcc_jax.runtime")
    runtime.import_jax()
    return getattr(importlib.import_module(f"dcc_jax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]


class _Package(types.ModuleType):
    """Keeps `dcc_jax.train` the function when the module of that name is imported.

    Python binds an imported submodule in its package; `from dcc_jax.train import main`
    works all the same.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
