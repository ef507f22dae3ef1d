"""MJX, imported in silence: it prints that Warp is missing, a matter of CUDA."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
