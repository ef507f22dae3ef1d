"""The process: where compiled programs are kept, and which OpenGL was asked for."""

import os
import subprocess
import sys
from pathlib import Path

from dcc_jax import runtime

PRINT_CACHE = """
from dcc_jax import runtime
runtime.setup()
import jax
print(jax.config.jax_compilation_cache_dir)
"""


def cache_of(**environment: str) -> tuple[str, str]:
    """(cache directory, what was said) of a process with these variables alone."""
    kept = {k: os.environ[k] for k in ("PATH", "PYTHONPATH") if k in os.environ}
    done = subprocess.run(
        [sys.executable, "-c", PRINT_CACHE],
        env=kept | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def test_compiled_programs_are_kept_in_the_home_directory(tmp_path):
    folder, said = cache_of(HOME=str(tmp_path))
    assert folder == str(tmp_path / ".cache" / "dcc_jax")
    assert Path(folder).is_dir()
    assert not said


def test_a_home_that_cannot_be_written_goes_without_cache_in_one_line(tmp_path):
    (tmp_path / "home").write_text("no folder")
    folder, said = cache_of(HOME=str(tmp_path / "home"))
    assert folder == "None"
    assert said.count("\n") == 1 and "DCC_JAX_CACHE=DIR keeps them" in said


def test_a_user_without_home_goes_without_cache_in_one_line(monkeypatch, capsys):
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(runtime.Path, "home", homeless)
    monkeypatch.delenv("DCC_JAX_CACHE", raising=False)
    assert runtime._usable_cache(None) == ""
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "Could not determine home" in said


def test_a_cache_that_is_named_needs_no_home(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime.Path, "home", lambda: 1 / 0)
    monkeypatch.setenv("DCC_JAX_CACHE", str(tmp_path / "new" / "cache"))
    assert runtime._usable_cache(None) == str(tmp_path / "new" / "cache")
    assert runtime._usable_cache(str(tmp_path)) == str(tmp_path)
    monkeypatch.setenv("DCC_JAX_CACHE", "")
    assert runtime._usable_cache(None) == ""


def test_a_cache_that_is_read_only_is_not_used(tmp_path, monkeypatch, capsys):
    # To root every folder is writable.
    monkeypatch.setattr(runtime.os, "access", lambda *_: False)
    assert runtime._usable_cache(str(tmp_path)) == ""
    assert f"{tmp_path} is not writable" in capsys.readouterr().err


def test_an_opengl_that_mujoco_cannot_load_is_one_line_and_status_two():
    done = subprocess.run(
        [sys.executable, "-m", "dcc_jax.render", "push"],
        env={**os.environ, "MUJOCO_GL": "nonsense"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "MUJOCO_GL=nonsense" in done.stderr
