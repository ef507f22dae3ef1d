"""The contact solver's kernel for CPUs (`newton_kernel.cc`): compiled at first use.

It needs a C++ compiler: `CXX`, `c++`, `g++` or `clang++`, or the pip package `ziglang`.
Without one, and on every other device, `contact_solver` goes on in JAX: the same result
to single precision, more slowly, and compiled for longer. DCC_JAX_NATIVE=0 asks for it.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax.physics.sparsity import Arrow

Array = jax.Array

SOURCE = Path(__file__).with_name("newton_kernel.cc")
TARGET = "dcc_newton"
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


@cache
def available() -> bool:
    """Whether the kernel serves this process: on a CPU, compiled and registered."""
    if os.environ.get(SETTING) == "0" or jax.default_backend() != "cpu":
        return False
    try:
        library = ctypes.cdll.LoadLibrary(str(_compiled()))
        jax.ffi.register_ffi_target(
            TARGET, jax.ffi.pycapsule(library.dcc_newton), platform="cpu"
        )
    except (OSError, subprocess.SubprocessError) as error:
        why = f"contact solver in JAX, which is slower: {_reason(error)}"
        print(f"dcc_jax: {why}", file=sys.stderr)
        return False
    return True


def newton(
    shape: Arrow,
    num_equality: int,
    iterations: int,
    mass: Array,
    smooth: Array,
    J: Array,
    D: Array,
    aref: Array,
    start: Array,
) -> tuple[Array, Array]:
    """`contact_solver.newton` of one environment; a batch by `vmap`."""
    call = jax.ffi.ffi_call(
        TARGET,
        (
            jax.ShapeDtypeStruct((shape.nv,), np.float32),
            jax.ShapeDtypeStruct((shape.num_rows,), np.float32),
        ),
        vmap_method="broadcast_all",
    )
    qacc, force = call(
        *(mass, smooth, J, D, aref, start, jnp.asarray(iterations, jnp.int32)),
        structure=_packed(shape, num_equality),
    )
    return qacc, force


def _packed(shape: Arrow, num_equality: int) -> np.ndarray:
    """The arrow as numbers: every limb, then the core, padding left out."""
    core = shape.core[shape.core < shape.nv]
    parts = []
    for stack in shape.stacks:
        for dofs, coupled, rows in zip(stack.dofs, stack.core, stack.rows, strict=True):
            dofs, rows = dofs[dofs < shape.nv], rows[rows < shape.num_rows]
            coupled = coupled[coupled < len(core)]
            counts = [len(dofs), len(coupled), len(rows)]
            parts.append([counts, dofs, core[coupled], coupled, rows])
    parts.append([[len(core), 0, len(shape.core_rows)], core, shape.core_rows])
    head = [shape.nv, shape.num_rows, num_equality, len(parts)]
    return np.concatenate([head, *(x for part in parts for x in part)]).astype(np.int32)


def _compiled() -> Path:
    """The shared library, in the cache of compiled programs."""
    command, source = [*_compiler(), *FLAGS], SOURCE.read_bytes()
    text = " ".join([*command, platform.machine(), _processor(), jax.__version__])
    name = hashlib.sha256(source + text.encode()).hexdigest()[:16]
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    folder = Path(cache or tempfile.mkdtemp())
    library = folder / f"newton-{name}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            made = Path(work) / "newton.so"
            include = f"-I{jax.ffi.include_dir()}"
            subprocess.run(
                [*command, include, str(SOURCE), "-o", str(made)],
                check=True,
                capture_output=True,
                text=True,
                timeout=300,
            )
            made.replace(library)
    return library


def _compiler() -> list[str]:
    for name in (os.environ.get("CXX"), "c++", "g++", "clang++"):
        if name and shutil.which(name):
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
        return next((x for x in error.stderr.splitlines() if "error" in x), str(error))
    return str(error)
