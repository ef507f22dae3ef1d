"""What the commands have in common: bad input is one line and status 2."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from typing import NoReturn, TypeVar

from dcc_jax import runtime

T = TypeVar("T")


class Parser(argparse.ArgumentParser):
    """A parser that raises ValueError where argparse prints and exits."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see --help")


def run(
    parser: Parser,
    argv: Sequence[str] | None,
    prepare: Callable[[argparse.Namespace], T],
    execute: Callable[[T, argparse.Namespace], None],
) -> int:
    """Carries out a command; returns its exit status.

    Args:
        parser: of its arguments; its `prog` is what complaints begin with.
        argv: the arguments; None: the process's own.
        prepare: everything that may find bad input, which is status 2.
        execute: the work, with what `prepare` returned; what goes wrong is status 1.
    """
    program = parser.prog.removeprefix("python -m ")
    try:
        options = parser.parse_args(argv)
        runtime.ensure()
        prepared = prepare(options)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        return complain(program, str(error), 2)
    try:
        execute(prepared, options)
    except KeyboardInterrupt:
        return complain(program, "interrupted", 1)
    except Exception as error:
        return fail(program, error)
    return 0


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
