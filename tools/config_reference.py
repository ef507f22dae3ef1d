"""Writes `docs/configuration.md` from the configuration's dataclasses.

`python -m tools.config_reference` writes the page; a test compares it with what `page`
returns, so a field and its description have one home: the dataclass.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dcc_jax import tasks
from dcc_jax.config import PRESETS, make_config
from dcc_jax.env.task import Task

PAGE = Path(__file__).resolve().parents[1] / "docs" / "configuration.md"
TYPICAL = "door"  # a task that changes no preset

_OPENING = """# Configuration

Everything you can set, with its default. This page is generated from the source:
`python -m tools.config_reference`.

| you want to set | you write |
|---|---|
| an option on the command line | `dcc-jax train --task push --ppo.clip 0.1` |
| the same from Python | `config.with_({"ppo.clip": 0.1})` |
| where defaults come from | `--preset cpu`, `smoke`, `gpu` or `paper` |
| a parameter of the task | `--task.interval 2.0` |
| to see every option | `dcc-jax train --task push --help` |

On the command line an underscore may be written as a dash: `--train.total-tuples`.
A run keeps what it was trained with in its `config.json`.

```python
import dcc_jax

config = dcc_jax.make_config("push", preset="cpu")
config = config.with_({"ppo.clip": 0.1, "env.alpha": 0.08, "task.interval": 2.0})
```
"""

_SECTIONS = {
    "": "The run",
    "env": "Environment",
    "env.compliance": "Compliance",
    "env.reward": "Reward",
    "ppo": "Policy and value function",
    "disc": "Discriminator",
    "train": "Training",
}


def page() -> str:
    """The whole page, ending in a newline."""
    parts = [_OPENING, _presets()]
    parts += [
        f"## {title}\n\n{_table(_section_rows(path))}"
        for path, title in _SECTIONS.items()
    ]
    parts.append(
        "## Tasks\n\nThe task's own parameters. Where a task trains with other "
        "settings than the presets `cpu` and `gpu`, they are listed below its table."
    )
    parts += [_task(kind) for kind in tasks.TASKS.values()]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _presets() -> str:
    """The options whose values the presets do not share."""
    values = {name: dict(_flat(make_config(TYPICAL, name))) for name in PRESETS}
    names = [
        name
        for name in values["cpu"]
        if name != "preset" and len({repr(of[name]) for of in values.values()}) > 1
    ]
    head = f"| option | {' | '.join(PRESETS)} |\n|---|{'--:|' * len(PRESETS)}"
    rows = [
        f"| `{name}` | {' | '.join(_shown(of[name]) for of in values.values())} |"
        for name in names
    ]
    return "## Presets\n\nWhat they differ in:\n\n" + "\n".join([head, *rows])


def _flat(section: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of every entry but the task's own."""
    for entry in dataclasses.fields(section):
        value, name = getattr(section, entry.name), f"{prefix}{entry.name}"
        if isinstance(value, Task):
            continue
        if _is_section(value):
            yield from _flat(value, f"{name}.")
        else:
            yield name, value


def _section_rows(path: str) -> list[tuple[str, Any, str]]:
    """(dotted name, value with `cpu`, description) of a section's own entries."""
    section: Any = make_config(TYPICAL)
    for name in filter(None, path.split(".")):
        section = getattr(section, name)
    rows = _rows(section, f"{path}." if path else "")
    return [row for row in rows if row[0] == "task" or not _is_section(row[1])]


def _rows(section: Any, prefix: str) -> list[tuple[str, Any, str]]:
    """Of all entries; a section in it needs no description.

    Raises:
        ValueError: another entry without one.
    """
    said = descriptions(type(section))
    rows = []
    for entry in dataclasses.fields(section):
        name, value = f"{prefix}{entry.name}", getattr(section, entry.name)
        if entry.name not in said and not _is_section(value):
            raise ValueError(f"{type(section).__name__}.{entry.name} has no docstring")
        rows.append((name, value, said.get(entry.name, "")))
    return rows


def _is_section(value: Any) -> bool:
    return dataclasses.is_dataclass(value)


def _task(kind: type[Task]) -> str:
    rows = list(_task_rows(kind(), "task."))
    body = _table(rows) if rows else "No parameters."
    summary = (inspect.getdoc(kind) or "").partition("\n")[0]
    parts = [
        f"### `{kind.name}`",
        f"{summary} See [its page](skills/{kind.name}.md).",
        body,
    ]
    own = [f"`{name}` = {_shown(x)}" for name, x in kind.config_overrides.items()]
    if own:
        parts.append(f"Trains with {', '.join(own)} (presets `cpu` and `gpu`).")
    return "\n\n".join(parts)


def _task_rows(section: Any, prefix: str) -> Iterator[tuple[str, Any, str]]:
    for name, value, said in _rows(section, prefix):
        if _is_section(value):
            yield from _task_rows(value, f"{name}.")
        else:
            yield name, value, said


def _table(rows: list[tuple[str, Any, str]]) -> str:
    lines = ["| option | default | meaning |", "|---|---|---|"]
    for name, value, said in rows:
        default = "required" if name == "task" else _shown(value)
        lines.append(f"| `{name}` | {default} | {_cell(said)} |")
    return "\n".join(lines)


def _shown(value: Any) -> str:
    if value == () or value == "":
        return "empty"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple):
        return ", ".join(_shown(item) for item in value)
    if isinstance(value, int) and not isinstance(value, bool) and value >= 10_000:
        return f"{value:,}"
    return str(value)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def descriptions(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass, by name, its bases' included."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        if dataclasses.is_dataclass(base):
            found |= _own_descriptions(base)
    return found


def _own_descriptions(kind: type) -> dict[str, str]:
    source = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(source, ast.ClassDef)
    return {
        field.target.id: said.value.value
        for field, said in zip(source.body, source.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(said, ast.Expr)
        and isinstance(said.value, ast.Constant)
        and isinstance(said.value.value, str)
    }


if __name__ == "__main__":
    PAGE.write_text(page())
