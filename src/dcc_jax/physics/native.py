"""The contact solver's kernel for CPUs (`newton_kernel.cc`): compiled at first use.

It makes the mass matrix and the rows of the contacts itself: written out as the solver
in JAX has them, they cost more than to solve with them.

It needs a C++ compiler: `CXX`, `c++`, `g++` or `clang++`, or the pip package `ziglang`.
Without one, and on every other device, `contact_solver` goes on in JAX: the same result
to single precision, more slowly, and compiled for longer. DCC_JAX_NATIVE=0 asks for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax.physics.contact_rows import ContactRows, contact_rows
from dcc_jax.physics.quiet_mjx import mjx
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


_one_at_a_time = threading.Lock()


def begin() -> None:
    """Compiles the kernel, if it has to be, while the caller goes on."""

    def compiled() -> None:
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            _compiled()  # whoever needs it complains

    if _wanted():
        threading.Thread(target=compiled).start()


@cache
def available() -> bool:
    """Whether the kernel serves this process: on a CPU, compiled and registered."""
    if not _wanted():
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


@flax.struct.dataclass
class Problem:
    """What the kernel makes mass matrix and constraint rows of.

    E rows are of equalities and limits, the other four of each of C contacts.
    """

    inertia: Array  # [nbody, 10] of the composite bodies, about their tree's centre
    motion: Array  # [nv, 6] axes, angular then linear, about the same
    center_w: Array  # [nbody, 3] m, centre of mass of what hangs on each body
    qvel: Array  # [nv]
    smooth: Array  # [nv] all generalized forces but those of constraints
    start: Array  # [nv] accelerations to start from
    J: Array  # [E, nv]
    D: Array  # [E + C] inverse regularization of each row, and of a contact's rows
    aref: Array  # [E + C] reference acceleration; of a contact without its damping
    contacts: ContactRows


def problem(model: mjx.Model, data: mjx.Data, smooth: Array, start: Array) -> Problem:
    """Of a state with its kinematics, composite inertias and contacts."""
    apart = data._impl.contact.replace(dim=np.zeros_like(data._impl.contact.dim))
    rows = mjx.make_constraint(model, data.tree_replace({"_impl.contact": apart}))._impl
    contacts = contact_rows(model, data)
    return Problem(
        inertia=data._impl.crb,
        motion=data.cdof,
        center_w=data.subtree_com,
        qvel=data.qvel,
        smooth=smooth,
        start=start,
        J=rows.efc_J,
        D=jnp.concatenate([rows.efc_D, contacts.D]),
        aref=jnp.concatenate([rows.efc_aref, contacts.aref]),
        contacts=contacts,
    )


def newton(
    shape: Arrow, layout: Layout, given: Problem, iterations: int
) -> tuple[Array, Array]:
    """`contact_solver.newton` of one environment; a batch by `vmap`.

    Args:
        shape: of the scene's matrices.
        layout: of its degrees of freedom and contacts.
        given: what to solve.
        iterations: the most Newton iterations.
    """
    call = jax.ffi.ffi_call(
        TARGET,
        (
            jax.ShapeDtypeStruct((shape.nv,), np.float32),
            jax.ShapeDtypeStruct((shape.num_rows,), np.float32),
        ),
        vmap_method="broadcast_all",
    )
    contacts = given.contacts
    qacc, force = call(
        given.inertia,
        given.motion,
        given.center_w,
        given.qvel,
        given.smooth,
        given.start,
        given.J,
        given.D,
        given.aref,
        contacts.frame_w,
        contacts.point_w,
        contacts.friction,
        contacts.damping,
        jnp.asarray(iterations, jnp.int32),
        structure=_packed(shape, layout),
        armature=layout.armature,
    )
    return qacc, force


@dataclass(frozen=True, eq=False)
class Layout:
    """What is static of a scene's degrees of freedom and rows."""

    num_bodies: int
    num_equality: int  # rows, the first
    num_contacts: int  # C; four rows each, the last
    parent: np.ndarray  # [nv] dof, -1: none
    body: np.ndarray  # [nv] that a dof moves
    root: np.ndarray  # [nv] first body of its tree
    last: np.ndarray  # [C, 2] last dof that moves each body of a contact, -1: none
    armature: np.ndarray  # [nv]

    @classmethod
    def of(
        cls, model: mujoco.MjModel, contact_bodies: np.ndarray, num_equality: int
    ) -> Layout:
        """Of a model, with the bodies [C, 2] of its contact slots."""
        last = [_last_dof(model, body) for body in contact_bodies.ravel()]
        return cls(
            num_bodies=model.nbody,
            num_equality=num_equality,
            num_contacts=len(contact_bodies),
            parent=model.dof_parentid,
            body=model.dof_bodyid,
            root=model.body_rootid[model.dof_bodyid],
            last=np.array(last, int).reshape(-1, 2),
            armature=model.dof_armature.astype(np.float32),
        )


def _last_dof(model: mujoco.MjModel, body: int) -> int:
    while body and not model.body_dofnum[body]:
        body = model.body_parentid[body]
    return model.body_dofadr[body] + model.body_dofnum[body] - 1 if body else -1


def _packed(shape: Arrow, layout: Layout) -> np.ndarray:
    """Layout and arrow as numbers: every limb, then the core, padding left out."""
    core = shape.core[shape.core < shape.nv]
    parts = []
    for stack in shape.stacks:
        for dofs, coupled, rows in zip(stack.dofs, stack.core, stack.rows, strict=True):
            dofs, rows = dofs[dofs < shape.nv], rows[rows < shape.num_rows]
            coupled = coupled[coupled < len(core)]
            counts = [len(dofs), len(coupled), len(rows)]
            parts += [counts, dofs, core[coupled], coupled, rows]
    parts += [[len(core), 0, len(shape.core_rows)], core, shape.core_rows]
    given = shape.num_rows - 4 * layout.num_contacts
    head = [shape.nv, shape.num_rows, layout.num_equality, given, layout.num_bodies]
    dofs = layout.parent, layout.body, layout.root, layout.last.ravel()
    count = [sum(len(stack.dofs) for stack in shape.stacks) + 1]
    return np.concatenate([head, *dofs, count, *parts]).astype(np.int32)


def _wanted() -> bool:
    return os.environ.get(SETTING) != "0" and jax.default_backend() == "cpu"


def _compiled() -> Path:
    """The shared library, in the cache of compiled programs."""
    with _one_at_a_time:
        return _made()


@cache
def _made() -> Path:
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
