"""The architecture: who may import whom (levels of the design, lowest first)."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import TypeGuard

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "dcc_jax"
LEVELS = {
    "quat": 0,
    "runtime": 0,
    "draw": 0,  # pictures from plain arrays; the motion commands show clips with it
    "draw_plain": 0,
    "logs": 0,
    "command": 0,
    "curves": 0,  # reads what the logs wrote
    "character": 1,
    "arrow": 1,
    "sparsity": 1,
    "solver": 1,
    "physics": 2,
    "motion": 3,
    "control": 4,
    "env": 5,
    "tasks": 6,
    "learn": 7,
    "config": 8,
    "checkpoint": 9,  # the training loop saves and resumes
    "training": 9,
    "options": 9,
    "train": 9,
    "evaluate": 10,
    "render": 10,
    "sweep": 10,
}
FILES = sorted(PACKAGE.rglob("*.py"))


def module_name(file: Path) -> str:
    """`dcc_jax.control.pd` of the file; a package is named by its folder."""
    parts = ("dcc_jax", *file.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


def unit(module: str) -> str:
    """The entry of LEVELS that a module of the library belongs to."""
    return module.split(".")[1] if "." in module else ""


def imports(file: Path) -> list[str]:
    """Absolute names of all that a file imports when it runs, also inside functions.

    What stands under `if TYPE_CHECKING` is read by people and checkers alone.
    """
    tree = ast.parse(file.read_text())
    types = [node for node in ast.walk(tree) if _is_for_types(node)]
    unseen = {
        id(inner) for node in types for part in node.body for inner in ast.walk(part)
    }
    package = module_name(file)
    if file.name != "__init__.py":
        package = package.rpartition(".")[0]
    names = []
    for node in (node for node in ast.walk(tree) if id(node) not in unseen):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            source = importlib.util.resolve_name(relative, package)
            names += [f"{source}.{alias.name}" for alias in node.names]
    return names


def _is_for_types(node: ast.AST) -> TypeGuard[ast.If]:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def parametrized(files: list[Path]):
    return pytest.mark.parametrize("file", files, ids=[module_name(f) for f in files])


MODULES = [file for file in FILES if unit(module_name(file))]


@parametrized(MODULES)
def test_imports_go_to_the_same_or_a_lower_level(file):
    own = unit(module_name(file))
    assert own in LEVELS, f"give {own!r} a level in this test and in the design"
    for name in imports(file):
        target = unit(name) if within(name, "dcc_jax") else ""
        if target in LEVELS:
            assert LEVELS[target] <= LEVELS[own], f"{own} must not import {name}"


@parametrized([file for file in MODULES if unit(module_name(file)) == "env"])
def test_env_knows_no_task_and_no_discriminator(file):
    for name in imports(file):
        assert not within(name, "dcc_jax.tasks")
        assert not within(name, "dcc_jax.learn")
        assert "discriminator" not in name


@parametrized([file for file in FILES if file.name != "physics.py"])
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


def test_the_walk_sees_nested_imports_but_not_those_for_types(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    file = tmp_path / "env" / "features.py"
    file.parent.mkdir()
    file.write_text(
        "import mujoco.mjx as m\n"
        "def f():\n    from ..tasks import push\n"
        "if TYPE_CHECKING:\n    from dcc_jax import train\n"
    )
    assert set(imports(file)) == {"dcc_jax.tasks.push", "mujoco.mjx"}
