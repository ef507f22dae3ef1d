"""A run's configuration: the sections composed, changes, presets, json in and out."""

from __future__ import annotations

import json
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dcc_jax import tasks
from dcc_jax.config import presets, sections
from dcc_jax.config.presets import PRESETS, Preset
from dcc_jax.env.config import EnvConfig
from dcc_jax.env.task import Task
from dcc_jax.learn.discriminator import DiscriminatorConfig
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.state import TrainConfig


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run learns."""

    task: Task
    """What the character does (Sec. 5.2-5.4), with the parameters of its own."""

    preset: Preset = "cpu"
    """Where the defaults below come from: `smoke` runs every part in seconds, `cpu` and
    `gpu` have batches for that hardware, `paper` has the paper's numbers (Sec. 5.1)."""

    seed: int = 0
    """Of everything that is drawn; the same seed gives the same run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    disc: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        if not isinstance(self.task, Task):
            raise ValueError(
                f"task must be a Task, got {self.task!r}; make_config takes a name"
            )
        if self.preset not in PRESETS:
            raise ValueError(
                f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}"
            )
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be between 0 and 2^32 - 1, got {self.seed}")

    def with_(self, changes: Mapping[str, Any]) -> Config:
        """The same with some values changed.

        Args:
            changes: new values by dotted name, as on the command line:
                `{"ppo.clip": 0.1, "task.width": 1.3}`. All change at once.

        Raises:
            ValueError: an unknown name, a value of another type or out of range.
        """
        if "preset" in changes:
            raise ValueError(
                "preset says where a configuration began and cannot be changed; "
                "make_config takes one"
            )
        return sections.changed(self, changes)


def make_config(task: str | Task | type[Task], preset: str = "cpu") -> Config:
    """The configuration of a task; `with_` changes it.

    With `cpu` and `gpu` the task's own `config_overrides` count, where it has any.

    Args:
        task: its name, `package.module:Name` of one that lies elsewhere, its class, or
            one with parameters: `Door(width=1.3)`.
        preset: `smoke`, `cpu`, `gpu` or `paper`.

    Raises:
        ValueError: there is no such task or preset; the message lists those there are.
    """
    made = Config(task=tasks.make_task(task), preset=typing.cast(Preset, preset))
    own = made.task.config_overrides if preset in ("cpu", "gpu") else {}
    return made.with_({**presets.CHANGES[made.preset], **own})


def to_json(config: Config) -> str:
    """The configuration as indented json.

    Raises:
        ValueError: a task has a parameter that json cannot hold.
    """
    return json.dumps(sections.as_data(config), indent=2, default=_refused) + "\n"


def from_json(text: str) -> Config:
    """The inverse of `to_json`; a task may be its name alone.

    Raises:
        ValueError: not json, an unknown or missing name, or a value out of range.
    """
    data = json.loads(text)
    if not isinstance(data, dict):
        raise ValueError("config.json holds no object")
    return sections.from_data(Config, data)


def load(run_dir: Path) -> Config:
    """The configuration of a run directory, or of a policy that ships.

    Raises:
        ValueError: it is not such a directory.
    """
    path = Path(run_dir) / "config.json"
    try:
        return from_json(path.read_text())
    except OSError:
        raise ValueError(f"{run_dir} is not a run directory: no config.json") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def differences(old: Config, new: Config) -> list[tuple[str, Any, Any]]:
    """(name, old value, new value) wherever two configurations differ."""
    before, after = sections.flat(old), sections.flat(new)
    return [
        (name, before.get(name), after.get(name))
        for name in before | after
        if before.get(name) != after.get(name)
    ]


def _refused(value: Any) -> None:
    raise ValueError(
        f"config.json holds numbers, text and tuples of them, not a "
        f"{type(value).__name__}: {value!r}"
    )
