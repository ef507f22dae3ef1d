"""The wheel carries what the library needs, and works away from the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
USE = """
from pathlib import Path
import dcc_jax
from dcc_jax.character import asset_path, load_character
print(Path(dcc_jax.__file__).parent)
print(asset_path("character.xml").parent)
print(load_character().spec().compile().nq)
"""


def run(*command: str, **kwargs) -> str:
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, **kwargs
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder into which the wheel was installed, without what it depends on."""
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    wheels, target = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("site")
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation")
    run(*build, "--outdir", str(wheels), str(ROOT))
    (wheel,) = wheels.glob("*.whl")
    pip = (sys.executable, "-m", "pip", "install", "--no-deps", "--no-index")
    run(*pip, "--target", str(target), str(wheel))
    return target


def test_character_loads_from_an_installed_wheel(installed, tmp_path):
    env = {**os.environ, "PYTHONPATH": str(installed)}
    package, assets, nq = run(sys.executable, "-c", USE, cwd=tmp_path, env=env).split()
    assert Path(package) == installed / "dcc_jax"
    assert Path(assets) == installed / "dcc_jax" / "assets"
    assert nq == "55"


def test_wheel_brings_the_command(installed, tmp_path):
    """Its help needs nothing but tyro, and the installed package, not the checkout."""
    env = {**os.environ, "PYTHONPATH": str(installed)}
    script = str(installed / "bin" / "dcc-jax")
    said = run(script, "evaluate", "--help", cwd=tmp_path, env=env)
    assert said.startswith("usage: dcc-jax evaluate ")


def test_wheel_is_typed_and_holds_every_module_and_asset(installed):
    assert (installed / "dcc_jax" / "py.typed").exists()
    for folder, top in (("src/dcc_jax", "dcc_jax"), ("assets", "dcc_jax/assets")):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                place = installed / top / file.relative_to(ROOT / folder)
                assert place.exists(), f"{file} is not in the wheel"
