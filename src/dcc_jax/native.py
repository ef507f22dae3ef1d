"""The kernels for CPUs (`kernels/*.cc`): compiled at first use, called by XLA.

They need a C++ compiler: `CXX`, `c++`, `g++` or `clang++`, or the pip package
`ziglang`. Without one, and on every other device, all goes on in JAX: the same
result to single precision, more slowly, and compiled for longer. DCC_JAX_NATIVE=0 asks
for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import jax

SOURCES = Path(__file__).with_name("kernels")
TARGETS = "dcc_admittance", "dcc_force", "dcc_kinematics", "dcc_newton"
SETTING = "DCC_JAX_NATIVE"
FLAGS = (
    "-O3",
    "-march=native",
    "-std=c++17",
    "-fno-math-errno",
    "-shared",
    "-fPIC",
    "-w",
)


_one_at_a_time = threading.Lock()


def begin() -> None:
    """Compiles the kernels, if they have to be, while the caller goes on."""

    def compiled() -> None:
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            _compiled()  # whoever needs it complains

    if _wanted():
        threading.Thread(target=compiled).start()


@cache
def available() -> bool:
    """Whether the kernels serve this process: on a CPU, compiled and registered."""
    if not _wanted():
        return False
    try:
        library = ctypes.cdll.LoadLibrary(str(_compiled()))
        for target in TARGETS:
            function = jax.ffi.pycapsule(getattr(library, target))
            jax.ffi.register_ffi_target(target, function, platform="cpu")
    except (OSError, subprocess.SubprocessError) as error:
        why = f"physics in JAX, which is slower: {_reason(error)}"
        print(f"dcc_jax: {why}", file=sys.stderr)
        return False
    return True


def _wanted() -> bool:
    return os.environ.get(SETTING) != "0" and jax.default_backend() == "cpu"


def _compiled() -> Path:
    """The shared library, in the cache of compiled programs."""
    with _one_at_a_time:
        return _made()


@cache
def _made() -> Path:
    command = [*_compiler(), *FLAGS]
    source = b"".join(path.read_bytes() for path in sorted(SOURCES.iterdir()))
    text = " ".join([*command, platform.machine(), _processor(), jax.__version__])
    name = hashlib.sha256(source + text.encode()).hexdigest()[:16]
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    folder = Path(cache or tempfile.mkdtemp())
    library = folder / f"kernels-{name}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            made = Path(work) / "kernels.so"
            build(SOURCES.glob("*.cc"), made)
            if not made.exists():
                raise OSError(f"{' '.join(_compiler())} made no library")
            made.replace(library)
    return library


def build(sources: Iterable[Path], library: Path) -> None:
    """Compiles C++ files into a shared library, as the kernels are.

    Raises:
        OSError: no compiler.
        subprocess.CalledProcessError: it failed; `stderr` says why.
    """
    include = f"-I{jax.ffi.include_dir()}", f"-I{SOURCES}"
    files = map(str, sorted(sources))
    subprocess.run(
        [*_compiler(), *FLAGS, *include, *files, "-o", str(library)],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )


def _compiler() -> list[str]:
    if asked := shlex.split(os.environ.get("CXX", "")):
        if shutil.which(asked[0]):
            return asked
        raise OSError(f"CXX={asked[0]} is no program")
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "c++"]
    raise OSError("no C++ compiler; `pip install ziglang` brings one")


def _processor() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("flags")), "")


def _reason(error: Exception) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        said = error.stderr.splitlines() or [str(error)]
        return next((line for line in said if "error" in line), said[0])
    return str(error)
