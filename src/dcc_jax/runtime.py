"""The process: devices, compile cache, version check. Nothing of the field.

Every command calls `setup()` before it imports jax. A library user calls it too, or
does not: importing dcc_jax changes nothing in the caller's process.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from pathlib import Path

_HANGING_ON_CPU = ("0.10.", "0.11.")

# XLA aborts the process when one host device waits 40 s for another, which a loaded
# machine or a suspended process makes it do; a day is as good as never.
_PATIENCE = {
    "--xla_cpu_collective_call_warn_stuck_timeout_seconds": 86400,
    "--xla_cpu_collective_call_terminate_timeout_seconds": 86400,
}


def setup(*, devices: int | None = None, cache_dir: str | None = None) -> None:
    """Configures JAX for this machine; call it before jax is imported.

    On a CPU it makes one JAX device per core, over which the environments are sharded:
    XLA's own threading does nothing for a batch of small matrices. It switches on the
    persistent compile cache and full float32 products.

    Args:
        devices: host devices on a CPU; default one per core this process may use, or
            what `DCC_JAX_DEVICES` says.
        cache_dir: of compiled programs; default `DCC_JAX_CACHE`, else
            `~/.cache/dcc_jax`. An empty string switches the cache off; where nothing
            can be written it is off with a word.

    Raises:
        RuntimeError: jax is imported already.
        ValueError: `devices` is not positive; MUJOCO_GL names what is not there.
        SystemExit: this version of jax hangs on this backend.
    """
    if "jax" in sys.modules:
        raise RuntimeError("runtime.setup() has to be called before jax is imported")
    _set_host_devices(devices)
    # Warm loads from the cache print long, harmless lines about machine features.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    if cache_dir := _usable_cache(cache_dir):
        jax.config.update("jax_compilation_cache_dir", cache_dir)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    jax.config.update("jax_default_matmul_precision", "highest")
    check_versions(jax.default_backend())
    check_graphics()


def _usable_cache(wanted: str | None) -> str:
    """The folder of compiled programs, made; "" where there cannot be one."""
    chosen = os.environ.get("DCC_JAX_CACHE") if wanted is None else wanted
    if chosen == "":
        return ""
    try:
        # Path.home() fails for a user without a home, as in many containers.
        folder = Path(chosen) if chosen else Path.home() / ".cache" / "dcc_jax"
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} is not writable")
    except (OSError, RuntimeError) as error:
        print(
            f"dcc_jax: compiled programs are not kept, so every start compiles anew "
            f"({error}); DCC_JAX_CACHE=DIR keeps them",
            file=sys.stderr,
        )
        return ""
    return str(folder)


def _set_host_devices(devices: int | None) -> None:
    flag = "--xla_force_host_platform_device_count"
    flags = os.environ.get("XLA_FLAGS", "")
    if devices is None:
        text = os.environ.get("DCC_JAX_DEVICES", "")
        if text and not text.isdecimal():
            raise ValueError(f"DCC_JAX_DEVICES must be a positive number, got {text!r}")
        devices = int(text) if text else len(os.sched_getaffinity(0))
    if devices < 1:
        raise ValueError(f"devices must be positive, got {devices}")
    wanted = {flag: devices, **_PATIENCE}
    missing = [f"{name}={value}" for name, value in wanted.items() if name not in flags]
    os.environ["XLA_FLAGS"] = " ".join([*flags.split(), *missing])


def check_versions(backend: str) -> None:
    """Stops with one sentence where this jax is known to hang.

    jax 0.10 and 0.11 deadlock in the thread pool of XLA's CPU backend when they run
    `vmap(mjx.step)`: no error, no load, for ever.
    """
    version = importlib.metadata.version("jax")
    if backend == "cpu" and version.startswith(_HANGING_ON_CPU):
        raise SystemExit(
            f"dcc_jax: jax {version} hangs for ever on the CPU backend; "
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
