"""What the commands have in common: bad input is one line and status 2."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import traceback
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser that raises ValueError where argparse prints and exits."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see --help")


def complain(program: str, problem: str, status: int) -> int:
    """Prints a problem as one line; returns the status to exit with."""
    with contextlib.suppress(OSError):
        print(f"{program}: {' '.join(problem.split())}", file=sys.stderr)
    return status


def fail(program: str, error: Exception) -> int:
    """Tells of an error nobody foresaw in one line, the rest in a file; returns 1."""
    reason = (str(error).splitlines() or [""])[0][:200]
    handle, log = tempfile.mkstemp(prefix=f"{program}-", suffix=".log")
    with open(handle, "w") as file:
        file.write("".join(traceback.format_exception(error)))
    return complain(program, f"{type(error).__name__}: {reason} (details in {log})", 1)


def leave(status: int) -> NoReturn:
    """Ends the process at once: XLA's threads can hold up an ordinary exit."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)
