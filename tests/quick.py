"""Programs that compile in half the time: what the tests do almost nothing else than.

`make test-all` has the compiler optimize as for users.
"""

from __future__ import annotations

from collections.abc import Mapping

QUICK = (
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
)
OPTIMIZED = "DCC_JAX_TEST_OPTIMIZED"  # set: as for users


def flags(environ: Mapping[str, str]) -> str:
    """XLA_FLAGS of the tests."""
    given = environ.get("XLA_FLAGS", "").split()
    added = () if environ.get(OPTIMIZED) else QUICK
    return " ".join([*given, *(flag for flag in added if flag not in given)])
