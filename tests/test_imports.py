"""The architecture: who may import whom."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "dcc_jax"
# One line a level, lowest first. A module belongs to the longest name here that it is
# or lies in, and imports only rooms of lower levels and its own.
LEVELS = [
    {"quat", "draws", "character", "runtime", "native", "viz", "motion.formats"},
    {"physics", "control", "motion", "command"},
    {"motion.retarget", "env"},
    {"motion.inspect", "tasks"},
    {"motion.__main__", "motion.inspect_command", "learn"},
    {"config"},
    {"training"},
    {"play", "options"},
    {"train", "evaluate", "render", "export", "__main__"},
    {"view"},
]
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
FILES = sorted(PACKAGE.rglob("*.py"))


def module_name(file: Path) -> str:
    """`dcc_jax.control.pd` of the file; a package is named by its folder."""
    parts = ("dcc_jax", *file.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


def room(name: str) -> str:
    """The entry of LEVELS that an imported name belongs to; empty for the package."""
    parts = name.split(".")[1:]
    heads = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((head for head in heads if head in LEVEL), "")


def imports(file: Path) -> list[str]:
    """Absolute names of all that a file imports: in functions and for types too."""
    tree = ast.parse(file.read_text())
    package = module_name(file)
    if file.name != "__init__.py":
        package = package.rpartition(".")[0]
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            source = importlib.util.resolve_name(relative, package)
            names += [f"{source}.{alias.name}" for alias in node.names]
    return names


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def parametrized(files: list[Path]):
    return pytest.mark.parametrize("file", files, ids=[module_name(f) for f in files])


MODULES = [file for file in FILES if module_name(file) != "dcc_jax"]


@parametrized(MODULES)
def test_imports_go_to_the_same_room_or_a_lower_level(file):
    own = room(module_name(file))
    assert own, f"give {module_name(file)!r} a level in this test"
    for name in imports(file):
        target = room(name) if within(name, "dcc_jax") else ""
        if target and target != own:
            assert LEVEL[target] < LEVEL[own], f"{own} must not import {name}"


@parametrized(MODULES)
def test_no_two_modules_import_each_other(file):
    """Also within a room, where levels do not say who comes first."""
    own = module_name(file)
    assert own not in reachable(own), f"{own} imports itself by way of others"


@cache
def direct(module: str) -> frozenset[str]:
    """The modules of the library that a module imports."""
    file = next(file for file in FILES if module_name(file) == module)
    known = {module_name(file) for file in FILES}
    found = set()
    for name in imports(file):
        found |= {name, name.rpartition(".")[0]} & known
    # A package stands for what it re-exports, its own modules aside.
    return frozenset(f for f in found if not within(module, f))


def reachable(module: str) -> set[str]:
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        for name in direct(waiting.pop()) - seen:
            seen.add(name)
            waiting.append(name)
    return seen


@parametrized([file for file in MODULES if room(module_name(file)) == "env"])
def test_env_knows_no_discriminator(file):
    for name in imports(file):
        assert "discriminator" not in name


@parametrized([file for file in FILES if file.parent.name != "physics"])
def test_only_physics_imports_mjx(file):
    for name in imports(file):
        assert not within(name, "mujoco.mjx"), name


def test_importing_the_library_changes_nothing_in_the_process():
    names = [module_name(file) for file in FILES if file.name != "__main__.py"]
    code = f"""
import importlib, os, jax
import orbax.checkpoint
watched = ("compilation_cache_dir", "default_matmul_precision", "enable_x64")
before = dict(os.environ), [getattr(jax.config, "jax_" + name) for name in watched]
for name in {names}:
    importlib.import_module(name)
after = dict(os.environ), [getattr(jax.config, "jax_" + name) for name in watched]
assert before == after, (set(after[0].items()) ^ set(before[0].items()), after[1])
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_walk_sees_nested_imports_and_those_for_types(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    file = tmp_path / "env" / "features.py"
    file.parent.mkdir()
    file.write_text(
        "import mujoco.mjx as m\n"
        "def f():\n    from ..tasks import push\n"
        "if TYPE_CHECKING:\n    from dcc_jax import train\n"
    )
    assert set(imports(file)) == {
        "dcc_jax.tasks.push",
        "dcc_jax.train",
        "mujoco.mjx",
    }
