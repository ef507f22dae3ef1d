"""The process: devices, compile cache, precision. Nothing of the field.

The first call of the library that needs jax's devices sets them up by `ensure()`.
Importing dcc_jax changes nothing in the caller's process.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

_HANGING_ON_CPU = ("0.10.", "0.11.")
_DEVICES_FLAG = "--xla_force_host_platform_device_count"

# XLA aborts the process when one host device waits 40 s for another, which a loaded
# machine or a suspended process makes it do; a day is as good as never.
_PATIENCE = {
    "--xla_cpu_collective_call_warn_stuck_timeout_seconds": 86400,
    "--xla_cpu_collective_call_terminate_timeout_seconds": 86400,
}

# Fusions compiled by XLA's older emitter run faster and compile sooner
# (docs/performance.md). XLA aborts on a flag that it does not know, and jax 0.12 no
# longer knows this one.
_WITH_OLDER_FUSIONS = "0.9."
_OLDER_FUSIONS = {"--xla_cpu_use_fusion_emitters": "false"}

_done = False


def ensure(
    *, devices: int | None = None, cache_dir: str | None = None, quiet: bool = False
) -> None:
    """Sets jax up for this machine; the second call and later ones do nothing.

    On a CPU it makes one JAX device per core, over which the environments are sharded:
    XLA's own threading does nothing for a batch of small matrices. It switches on the
    persistent compile cache and full float32 products. What the caller has set already
    stays, and so does a backend that is in use. One line on stderr tells the result.

    Args:
        devices: host devices on a CPU; default one per core this process may use, or
            what `DCC_JAX_DEVICES` says.
        cache_dir: of compiled programs; default `DCC_JAX_CACHE`, else
            `~/.cache/dcc_jax`. An empty string: no cache.
        quiet: not even that line.

    Raises:
        ValueError: `devices` is not positive, or this version of jax hangs on this
            backend.
    """
    global _done
    if _done:
        return
    joined = _processes()
    wanted = 1 if joined and devices is None else _wanted_devices(devices)
    import_jax()
    if joined:
        _join(*joined)
    said = [_set_devices(wanted), _set_cache(cache_dir), _set_precision()]
    check_versions(_backend())
    _done = True
    if not quiet:
        print(f"dcc_jax: {'; '.join(said)}", file=sys.stderr)


def import_jax() -> None:
    """Imports jax so that it stays silent when it loads compiled programs.

    It warns of every one that it cannot know the version. How much it says is settled
    when it is imported: who has imported it before has settled it.
    """
    if "jax" not in sys.modules:
        name = "TF_CPP_MIN_LOG_LEVEL"
        with _environment({name: os.environ.get(name, "3")}):
            importlib.import_module("jax")


def check_versions(backend: str) -> None:
    """Raises ValueError, of one sentence, where this jax is known to hang.

    jax 0.10 and 0.11 deadlock in the thread pool of XLA's CPU backend when they run
    `vmap(mjx.step)`: no error, no load, for ever.
    """
    version = importlib.metadata.version("jax")
    if backend == "cpu" and version.startswith(_HANGING_ON_CPU):
        raise ValueError(
            f"jax {version} hangs for ever on the CPU backend; "
            "install jax 0.9.2, or 0.12 and later"
        )


def check_graphics() -> None:
    """Finds out whether MuJoCo can be imported with the OpenGL that MUJOCO_GL names.

    Raises:
        ValueError: it cannot: the name is unknown, or its library is not installed.
    """
    wanted = os.environ.get("MUJOCO_GL")
    if not wanted:
        return
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # AttributeError where a library is missing
        raise ValueError(
            f"mujoco cannot be imported with MUJOCO_GL={wanted} ({error}); "
            "unset it, or install that OpenGL library"
        ) from None


def _wanted_devices(devices: int | None) -> int:
    if devices is None:
        text = os.environ.get("DCC_JAX_DEVICES", "")
        if text and not (text.isdecimal() and int(text)):
            raise ValueError(f"DCC_JAX_DEVICES must be a positive number, got {text!r}")
        devices = int(text) if text else cores()
    if devices < 1:
        raise ValueError(f"devices must be positive, got {devices}")
    return devices


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processes() -> tuple[str, int, int] | None:
    """Coordinator, number of processes and this one's, where there are several."""
    names = ("DCC_JAX_COORDINATOR", "DCC_JAX_PROCESSES", "DCC_JAX_PROCESS")
    said = [os.environ.get(name, "") for name in names]
    if not any(said):
        return None
    address, count, index = said
    right = bool(address) and count.isdecimal() and index.isdecimal()
    if not (right and int(index) < int(count)):
        told = ", ".join(f"{n}={text!r}" for n, text in zip(names, said, strict=True))
        raise ValueError(
            "several processes need DCC_JAX_COORDINATOR=HOST:PORT, DCC_JAX_PROCESSES=N "
            f"and DCC_JAX_PROCESS from 0 to N - 1, got {told}"
        )
    return address, int(count), int(index)


def _join(address: str, count: int, index: int) -> None:
    """Meets the other processes; gloo carries what CPUs exchange, in one order."""
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    jax.distributed.initialize(address, count, index)


def _set_devices(wanted: int) -> str:
    """Starts the backend, unless there is one; says which devices there are."""
    import jax

    flags = os.environ.get("XLA_FLAGS", "")
    by_flag = re.search(rf"{_DEVICES_FLAG}=(\d+)", flags)
    asked = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    theirs = int(by_flag[1]) if by_flag and asked < 0 else asked
    number = wanted if theirs < 0 else theirs
    try:
        jax.config.update("jax_num_cpu_devices", number)
    except RuntimeError:
        if len(jax.devices()) == wanted or _backend() != "cpu":
            return f"{_devices()}, jax was in use already"
        return f"jax was in use already: keeping its {_devices()} of {wanted} wanted"
    ours = dict(_PATIENCE)
    if importlib.metadata.version("jax").startswith(_WITH_OLDER_FUSIONS):
        ours |= _OLDER_FUSIONS
    missing = [f"{k}={v}" for k, v in ours.items() if k not in flags]
    # XLA reads its flags once, when the first backend starts.
    with _environment({"XLA_FLAGS": " ".join([*flags.split(), *missing])}):
        jax.devices()
    kept = theirs >= 0 and theirs != wanted and _backend() == "cpu"
    return f"keeping the {_devices()} that were set" if kept else _devices()


def _set_cache(wanted: str | None) -> str:
    """Switches the compile cache on; says where it is, or why there is none."""
    import jax

    theirs = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if theirs:
        return f"keeping the compile cache {theirs}"
    chosen = os.environ.get("DCC_JAX_CACHE") if wanted is None else wanted
    if chosen == "":
        return "no compile cache"
    try:
        # Path.home() fails for a user without a home, as in many containers.
        folder = Path(chosen) if chosen else Path.home() / ".cache" / "dcc_jax"
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} is not writable")
    except (OSError, RuntimeError) as error:
        return (
            f"no compile cache, every start compiles anew ({error}); "
            "DCC_JAX_CACHE=DIR makes one"
        )
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return f"compile cache {folder}"


def _set_precision() -> str:
    import jax

    name = "jax_default_matmul_precision"
    theirs = getattr(jax.config, name)
    if theirs is not None:
        return f"keeping matmul precision {theirs}"
    jax.config.update(name, "highest")
    return "matmul precision highest"


def _backend() -> str:
    import jax

    return jax.default_backend()


def _devices() -> str:
    import jax

    count = len(jax.devices())
    return f"{count} {_backend().upper()} device{'s' if count > 1 else ''}"


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Some environment variables as given, for a while."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
