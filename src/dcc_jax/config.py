"""A run's configuration: the sections composed, presets, json in and out."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from dcc_jax.env.config import EnvConfig
from dcc_jax.learn.discriminator import DiscriminatorConfig
from dcc_jax.learn.ppo import PpoConfig
from dcc_jax.learn.state import TrainConfig
from dcc_jax.tasks import TASKS

Preset = Literal["smoke", "cpu", "gpu", "paper"]
PRESETS: tuple[str, ...] = get_args(Preset)


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run learns."""

    task: str
    """What the character does; `push`, `trampoline` and the others (Sec. 5.2-5.4)."""

    preset: Preset = "cpu"
    """Where the defaults below come from: `smoke` runs every part in seconds, `cpu` and
    `gpu` learn fast on that hardware, `paper` has the paper's numbers (Sec. 5.1)."""

    seed: int = 0
    """Of everything that is drawn; the same seed gives the same run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    disc: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise ValueError(
                f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}"
            )
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be between 0 and 2^32 - 1, got {self.seed}")


def make_config(task: str, preset: str = "cpu") -> Config:
    """The configuration of a task; `dataclasses.replace` changes it.

    With `cpu` and `gpu` the task's own `config_overrides` count, where it has any.

    Args:
        task: its name.
        preset: `smoke`, `cpu`, `gpu` or `paper`.

    Raises:
        ValueError: there is no such preset.
    """
    base = Config(task=task, preset=typing.cast(Preset, preset))
    made = _VARIANTS[preset](base)
    own = (
        TASKS[task].config_overrides
        if task in TASKS and preset in ("cpu", "gpu")
        else {}
    )
    for name, value in own.items():
        made = _replaced(made, name.split("."), value)
    return made


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    """A section with one entry changed, `path` the names that lead to it."""
    name, *deeper = path
    if deeper:
        value = _replaced(getattr(config, name), deeper, value)
    return dataclasses.replace(config, **{name: value})


def _smoke(config: Config) -> Config:
    small = (32, 32)
    return dataclasses.replace(
        config,
        ppo=dataclasses.replace(config.ppo, hidden=small, minibatch_size=64, epochs=2),
        disc=dataclasses.replace(
            config.disc, hidden=small, minibatch_size=32, minibatches=2
        ),
        train=dataclasses.replace(
            config.train,
            num_envs=16,
            unroll_length=8,
            total_tuples=4 * 16 * 8,
            warm_start_steps=20,
            checkpoint_interval=2,
        ),
    )


def _cpu(config: Config) -> Config:
    """Many small updates, one pass over each: tuples are dear, and so is the learner.

    Four passes took half of an update, and taught no more: `target_kl` bounds what an
    update may change (docs/performance.md).
    """
    return dataclasses.replace(
        config,
        ppo=dataclasses.replace(
            config.ppo, discount=0.98, target_kl=0.04, minibatch_size=512, epochs=1
        ),
        disc=dataclasses.replace(config.disc, learning_rate=4e-5, minibatches=4),
        train=dataclasses.replace(
            config.train, unroll_length=16, checkpoint_interval=100
        ),
    )


def _gpu(config: Config) -> Config:
    return dataclasses.replace(
        config,
        ppo=dataclasses.replace(config.ppo, minibatch_size=16384),
        disc=dataclasses.replace(config.disc, minibatch_size=2048),
        train=dataclasses.replace(config.train, num_envs=4096, total_tuples=80_000_000),
    )


def _paper(config: Config) -> Config:
    """Sec. 5.1 verbatim. What it leaves open: 10 epochs are those of the authors' own
    earlier trainer (MASS, 2019), 2048 tuples come from 16 environments, one per core of
    their machine, and a discriminator pass is one over the tuples."""
    return dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, physics_rate=600),
        ppo=dataclasses.replace(
            config.ppo,
            value_learning_rate=1e-5,
            target_kl=None,
            minibatch_size=128,
            epochs=10,
        ),
        disc=dataclasses.replace(config.disc, minibatch_size=16, minibatches=128),
        train=dataclasses.replace(
            config.train,
            num_envs=16,
            unroll_length=128,
            warm_start_steps=0,
            total_tuples=80_000_000,
            checkpoint_interval=200,
        ),
    )


_VARIANTS: dict[str, Callable[[Config], Config]] = {
    "smoke": _smoke,
    "cpu": _cpu,
    "gpu": _gpu,
    "paper": _paper,
}


def to_json(config: Config) -> str:
    """The configuration as indented json."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(text: str) -> Config:
    """The inverse of `to_json`.

    Raises:
        ValueError: not json, an unknown or missing name, or a value out of range.
    """
    data = json.loads(text)
    if not isinstance(data, dict):
        raise ValueError("config.json holds no object")
    return _section(Config, data, "")


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


def differences(old: Any, new: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    """(name, old value, new value) wherever two configurations differ."""
    found = []
    for entry in dataclasses.fields(old):
        before, after = getattr(old, entry.name), getattr(new, entry.name)
        name = f"{prefix}{entry.name}"
        if dataclasses.is_dataclass(before) and type(before) is type(after):
            found += differences(before, after, f"{name}.")
        elif before != after:
            found.append((name, before, after))
    return found


def _section(kind: Any, data: dict[str, Any], prefix: str) -> Any:
    hints = typing.get_type_hints(kind)
    for name in data:
        if name not in hints:
            raise ValueError(f"unknown entry {prefix}{name}")
    values = {
        name: _value(hints[name], value, f"{prefix}{name}")
        for name, value in data.items()
    }
    try:
        return kind(**values)
    except TypeError as error:
        raise ValueError(f"{prefix or 'config'}: {error}") from None


def _value(hint: Any, value: Any, name: str) -> Any:
    """A json value as the dataclass holds it: sections and tuples restored."""
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return _section(hint, value, f"{name}.")
    if origin is types.UnionType or origin is typing.Union:
        sections = [h for h in get_args(hint) if dataclasses.is_dataclass(h)]
        if sections and isinstance(value, dict):
            return _section(sections[0], value, f"{name}.")
    if isinstance(value, list):
        return tuple(_value(None, item, name) for item in value)
    return value
