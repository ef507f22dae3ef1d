"""What the first call sets up, what it leaves as it was: each in a fresh process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from dcc_jax import runtime

SETTINGS = (
    *("XLA_FLAGS", "DCC_JAX_DEVICES", "DCC_JAX_CACHE", "TF_CPP_MIN_LOG_LEVEL"),
    *("JAX_NUM_CPU_DEVICES", "JAX_COMPILATION_CACHE_DIR"),
    "JAX_DEFAULT_MATMUL_PRECISION",
)
SHOW = """
import jax
print(len(jax.devices()), jax.config.jax_compilation_cache_dir,
      jax.config.jax_default_matmul_precision, sep="|")
"""
ENSURE = "from dcc_jax import runtime\nruntime.ensure()\n"


def _python(tmp_path, code: str, **variables: str) -> tuple[list[str], list[str]]:
    """The lines it prints, and those on stderr."""
    kept = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**kept, "JAX_PLATFORMS": "cpu", "HOME": str(tmp_path), **variables},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.splitlines(), done.stderr.splitlines()


def test_one_device_a_core_a_cache_and_full_precision_and_one_line(tmp_path):
    shown, said = _python(tmp_path, ENSURE + "runtime.ensure()" + SHOW)
    cache = tmp_path / ".cache" / "dcc_jax"
    assert shown == [f"{runtime.cores()}|{cache}|highest"]
    assert len(said) == 1
    for part in (f"{runtime.cores()} CPU device", f"compile cache {cache}", "highest"):
        assert part in said[0]


def test_environment_variables_stay_as_they_were(tmp_path):
    flags = "--xla_cpu_enable_fast_math=false"
    code = """
import os
import dcc_jax
dcc_jax.make_config
assert "TF_CPP_MIN_LOG_LEVEL" not in os.environ
# What importing jax itself leaves there is its own.
before = dict(os.environ)
from dcc_jax import runtime
runtime.ensure()
print(before == dict(os.environ), os.environ.get("XLA_FLAGS"))
"""
    assert _python(tmp_path, code)[0] == ["True None"]
    assert _python(tmp_path, code, XLA_FLAGS=flags)[0] == [f"True {flags}"]


def test_patience_reaches_xla_though_the_variable_is_gone(tmp_path):
    """With two seconds in place of a day, XLA gives up on a device that sleeps."""
    code = """
import os, sys, time
from dcc_jax import runtime
runtime._PATIENCE = {name: int(sys.argv[1]) for name in runtime._PATIENCE}
runtime.ensure(devices=2, quiet=True)
assert "XLA_FLAGS" not in os.environ
import jax, jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec
mesh = jax.make_mesh((2,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
split = PartitionSpec("d")

def wait(i):
    time.sleep(5.0 * float(i[0]))
    return i

def body(x):
    i = jax.pure_callback(wait, jax.ShapeDtypeStruct((1,), x.dtype), x)
    return jax.lax.psum(i, "d")

f = jax.jit(jax.shard_map(
    body, mesh=mesh, in_specs=split, out_specs=PartitionSpec(), check_vma=False))
print(f(jax.device_put(jnp.arange(2.0), NamedSharding(mesh, split))))
"""
    variables = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    ended = {
        seconds: subprocess.run(
            [sys.executable, "-c", code, seconds],
            capture_output=True,
            text=True,
            check=False,
            env={**variables, "JAX_PLATFORMS": "cpu", "DCC_JAX_CACHE": ""},
            timeout=300,
        )
        for seconds in ("2", "86400")
    }
    assert ended["86400"].stdout == "[1.]\n", ended["86400"].stderr[-2000:]
    assert ended["2"].returncode < 0, "XLA aborts the process"


@pytest.mark.parametrize(
    ("code", "variables", "expected", "line"),
    [
        ("", {"DCC_JAX_DEVICES": "3", "DCC_JAX_CACHE": ""}, "3|None|highest", "no com"),
        (
            "",
            {
                "XLA_FLAGS": "--xla_force_host_platform_device_count=3",
                "JAX_COMPILATION_CACHE_DIR": "/tmp/their-cache",
            },
            "3|/tmp/their-cache|highest",
            "keeping the 3 CPU devices that were set; "
            "keeping the compile cache /tmp/their-cache",
        ),
        (
            "import jax\n"
            "jax.config.update('jax_num_cpu_devices', 3)\n"
            "jax.config.update('jax_default_matmul_precision', 'bfloat16')\n",
            {"DCC_JAX_CACHE": ""},
            "3|None|bfloat16",
            "keeping matmul precision bfloat16",
        ),
        (
            "import jax\njax.numpy.ones(3)\n",
            {"DCC_JAX_CACHE": "", "DCC_JAX_DEVICES": "2"},
            "1|None|highest",
            "jax was in use already: keeping its 1 CPU device of 2 wanted",
        ),
        (
            "",
            {"DCC_JAX_CACHE": "/dev/null/cache", "DCC_JAX_DEVICES": "1"},
            "1|None|highest",
            "no compile cache, every start compiles anew",
        ),
    ],
)
def test_what_the_caller_has_set_stays_and_is_told(
    tmp_path, code, variables, expected, line
):
    shown, said = _python(tmp_path, code + ENSURE + SHOW, **variables)
    assert shown == [expected]
    assert len(said) == 1 and line in said[0]


def test_quiet_says_nothing(tmp_path):
    code = "from dcc_jax import runtime\nruntime.ensure(quiet=True)\n"
    assert _python(tmp_path, code) == ([], [])


def test_environment_is_made_with_the_devices_set_up(tmp_path):
    code = "import dcc_jax\nfrom dcc_jax import tasks\n"
    code += "config = dcc_jax.make_config('push', 'smoke')\n"
    code += "tasks.make_environment(config.task, config.env)\n"
    shown, said = _python(tmp_path, code + SHOW, DCC_JAX_DEVICES="2")
    assert shown[0].startswith("2|") and len(said) == 1


def test_number_of_devices_that_is_none_is_named(monkeypatch):
    with pytest.raises(ValueError, match="devices must be positive, got 0"):
        runtime._wanted_devices(0)
    monkeypatch.setenv("DCC_JAX_DEVICES", "two")
    with pytest.raises(ValueError, match=r"DCC_JAX_DEVICES must be .*'two'"):
        runtime._wanted_devices(None)
    monkeypatch.setenv("DCC_JAX_DEVICES", "0")
    with pytest.raises(ValueError, match=r"DCC_JAX_DEVICES must be .*'0'"):
        runtime._wanted_devices(None)


@pytest.mark.parametrize("version", ["0.10.0", "0.11.2"])
def test_jax_that_hangs_on_the_cpu_is_refused_there(version, monkeypatch):
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda name: version)
    with pytest.raises(ValueError, match=f"jax {version} hangs for ever"):
        runtime.check_versions("cpu")
    runtime.check_versions("gpu")


def test_jax_that_does_not_hang_is_taken(monkeypatch):
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda name: "0.12.0")
    runtime.check_versions("cpu")


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
