"""Nested dataclasses as dotted names and as json, their values checked by type.

A section is a frozen dataclass; `ppo.clip` is the entry `clip` of the section `ppo`. A
task is a section as well, and the name of its class comes first in it.
"""

from __future__ import annotations

import dataclasses
import numbers
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin

from dcc_jax import tasks
from dcc_jax.env.task import Task

S = TypeVar("S")
_NUMBERS = {int: numbers.Integral, float: numbers.Real}
_NOUNS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def as_data(section: Any) -> dict[str, Any]:
    """A section as dictionaries, for json."""
    data: dict[str, Any] = {}
    if isinstance(section, Task):
        data["name"] = tasks.task_name(section)
    for entry in dataclasses.fields(section):
        value = getattr(section, entry.name)
        data[entry.name] = as_data(value) if _is_section(value) else value
    return data


def from_data(kind: type[S], data: Mapping[str, Any], prefix: str = "") -> S:
    """The inverse of `as_data`.

    Args:
        kind: the dataclass.
        data: by name; what is missing has its default.
        prefix: of the names in messages, `ppo.`.

    Raises:
        ValueError: an unknown name, or a value of another type or out of range.
    """
    if issubclass(kind, Task):
        if "name" not in data:
            raise ValueError(f"{prefix}name is missing")
        found = tasks.find_task(_typed(str, data["name"], f"{prefix}name"))
        kind = typing.cast(type[S], found)
        data = {name: value for name, value in data.items() if name != "name"}
    hints = _hints(kind)
    _check_names(hints, data, prefix)
    values = {n: _typed(hints[n], value, f"{prefix}{n}") for n, value in data.items()}
    try:
        return kind(**values)
    except TypeError as error:
        raise ValueError(f"{prefix or 'config'}: {error}") from None


def changed(section: S, changes: Mapping[str, Any], prefix: str = "") -> S:
    """A section with entries changed, all at once.

    Args:
        section: a dataclass, left as it is.
        changes: new values by dotted name.
        prefix: of the names in messages.

    Raises:
        ValueError: as of `from_data`.
    """
    hints = _hints(type(section))
    deeper: dict[str, dict[str, Any]] = {}
    values: dict[str, Any] = {}
    for path, value in changes.items():
        name, _, rest = path.partition(".")
        inside = values.get(name, getattr(section, name, None))
        if rest and not _is_section(inside):
            raise ValueError(_unknown(f"{prefix}{path}", hints, prefix))
        _check_names(hints, {name: value}, prefix)
        if rest:
            deeper.setdefault(name, {})[rest] = value
        else:
            values[name] = _typed(hints[name], value, f"{prefix}{name}")
    for name, inner in deeper.items():
        before = values.get(name, getattr(section, name))
        values[name] = changed(before, inner, f"{prefix}{name}.")
    return dataclasses.replace(typing.cast(Any, section), **values)


def flat(section: Any, prefix: str = "") -> dict[str, Any]:
    """Every value by its dotted name; a task's own name is that of its section."""
    found: dict[str, Any] = {}
    if isinstance(section, Task):
        found[prefix.removesuffix(".")] = tasks.task_name(section)
    for entry in dataclasses.fields(section):
        value, name = getattr(section, entry.name), f"{prefix}{entry.name}"
        found |= flat(value, f"{name}.") if _is_section(value) else {name: value}
    return found


def _is_section(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _hints(kind: Any) -> dict[str, Any]:
    """The type of every field; class variables are no fields."""
    try:
        hints = typing.get_type_hints(kind)
    except NameError as error:
        raise ValueError(f"{kind.__name__}: a type cannot be found: {error}") from None
    return {entry.name: hints[entry.name] for entry in dataclasses.fields(kind)}


def _check_names(
    hints: Mapping[str, Any], data: Mapping[str, Any], prefix: str
) -> None:
    for name in data:
        if name not in hints:
            raise ValueError(_unknown(f"{prefix}{name}", hints, prefix))


def _unknown(name: str, hints: Mapping[str, Any], prefix: str) -> str:
    owner = prefix.removesuffix(".") or "a configuration"
    return f"unknown entry {name}; {owner} has {', '.join(hints) or 'none'}"


def _typed(hint: Any, value: Any, name: str) -> Any:
    """A value as the dataclass holds it: sections and tuples restored."""
    if _is_section_type(hint):
        return _section(hint, value, name)
    if get_origin(hint) in (types.UnionType, typing.Union):
        return _one_of(get_args(hint), value, name)
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        return _tuple(get_args(hint), value, name)
    if hint in _NUMBERS and not isinstance(value, bool):
        # Also numpy's, which json does not know.
        value = hint(value) if isinstance(value, _NUMBERS[hint]) else value
    if not _suits(hint, value):
        raise ValueError(f"{name} must be {_told(hint)}, got {value!r}")
    return tuple(value) if isinstance(value, list) else value


def _is_section_type(hint: Any) -> bool:
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def _section(kind: Any, value: Any, name: str) -> Any:
    if issubclass(kind, Task) and isinstance(value, str | type):
        return tasks.make_task(value)
    if isinstance(value, Mapping):
        return from_data(kind, value, f"{name}.")
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be {_told(kind)}, got {value!r}")
    return value


def _one_of(hints: tuple[Any, ...], value: Any, name: str) -> Any:
    for hint in hints:
        # A mapping is meant for the section among them, whose complaint says more.
        if _is_section_type(hint) and isinstance(value, Mapping):
            return _section(hint, value, name)
    for hint in hints:
        try:
            return _typed(hint, value, name)
        except ValueError:
            continue
    allowed = " or ".join(_told(hint) for hint in hints)
    raise ValueError(f"{name} must be {allowed}, got {value!r}")


def _tuple(hints: tuple[Any, ...], values: Any, name: str) -> tuple[Any, ...]:
    if hints[-1:] == (...,):
        return tuple(_typed(hints[0], value, name) for value in values)
    if len(hints) != len(values):
        raise ValueError(f"{name} must be {len(hints)} values, got {values!r}")
    return tuple(_typed(h, value, name) for h, value in zip(hints, values, strict=True))


def _suits(hint: Any, value: Any) -> bool:
    """Whether a value is of a plain type; what is not plain is taken as it is."""
    if get_origin(hint) is typing.Literal:
        return value in get_args(hint)
    if hint is int or hint is float:
        return isinstance(value, hint) and not isinstance(value, bool)
    if hint in (bool, str, type(None)):
        return isinstance(value, hint)
    return get_origin(hint) is not tuple


def _told(hint: Any) -> str:
    if get_origin(hint) is typing.Literal:
        return "one of " + ", ".join(str(value) for value in get_args(hint))
    if get_origin(hint) is tuple:
        return "several values"
    if hint is type(None):
        return "none"
    return _NOUNS.get(hint) or f"a {getattr(hint, '__name__', hint)}"
