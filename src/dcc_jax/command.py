"""What the commands have in common: arguments, complaints of one line, exit statuses.

A command's name is its module's, `dcc_jax.evaluate`: complaints begin with it.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO, TypeVar

import tyro

from dcc_jax import runtime

T = TypeVar("T")
Work = Callable[[], int | None]


class WorkError(Exception):
    """The work began and could not go on; the text is the line that says why."""


def run(
    program: str,
    argv: Sequence[str] | None,
    read: Callable[[list[str]], T],
    prepare: Callable[[T], Work],
) -> int:
    """Carries out a command; returns its exit status.

    Args:
        program: its name, `dcc_jax.evaluate`.
        argv: the arguments; None: the process's own.
        read: the arguments into options, mostly by `parse`.
        prepare: checks everything a user can get wrong, which is status 2, and
            returns the work. What goes wrong in the work is status 1; it may return
            a status of its own.
    """

    def carried_out() -> int:
        try:
            work = prepare(read(_arguments(argv)))
        # OSError: a directory that cannot be made, a clip that cannot be opened.
        except (ValueError, OSError, ModuleNotFoundError) as error:
            return complain(program, str(error), 2)
        return work() or 0

    return _guarded(program, carried_out)


def choose(
    program: str, commands: Mapping[str, tuple[str, str]], argv: Sequence[str] | None
) -> int:
    """Hands the arguments to the command that the first of them names.

    Args:
        program: the name that complaints begin with.
        commands: (module with a `main(argv)`, what it does in one line), by name.
        argv: the arguments; None: the process's own.
    """
    name, *others = _arguments(argv) or [""]
    if name in commands:
        module = commands[name][0]
        return _guarded(program, lambda: importlib.import_module(module).main(others))
    if name and name not in ("-h", "--help"):
        known = ", ".join(commands)
        return complain(program, f"no command {name!r}; there are {known}", 2)
    listed = [f"  {name:<9} {text}" for name, (_, text) in commands.items()]
    usage = f"usage: {_usage(program)} COMMAND [OPTIONS]; --help of each lists them"
    print("\n".join([usage, "", *listed]), file=sys.stdout if name else sys.stderr)
    return 0 if name else 2


def parse(
    program: str,
    kind: type[T],
    arguments: Sequence[str],
    default: T | None = None,
    description: str | None = None,
) -> T:
    """Reads arguments into a dataclass, as tyro does.

    Args:
        program: whose arguments they are; for the line of usage in the help.
        kind: the dataclass; its docstring is the description in the help.
        arguments: without the program's name.
        default: of every option; None: the dataclass's own defaults.
        description: in place of the docstring.

    Raises:
        ValueError: one line that says what is wrong.
        SystemExit: the help was printed.
    """
    options: dict[str, Any] = {} if default is None else {"default": default}
    options["description"] = description
    try:
        return _quietly(program, kind, arguments, options)
    except SystemExit:
        # The help was asked for. It goes to the terminal, as wide as that is.
        return tyro.cli(kind, prog=_usage(program), args=list(arguments), **options)


def parse_known(
    program: str, kind: type[T], arguments: Sequence[str]
) -> tuple[T, list[str]]:
    """The same without a help; returns as well the arguments that are not of `kind`.

    Raises:
        ValueError: one line that says what is wrong.
    """
    options = {"add_help": False, "return_unknown_args": True}
    return _quietly(program, kind, arguments, options)


def _quietly(
    program: str, kind: type[Any], arguments: Sequence[str], options: dict[str, Any]
) -> Any:
    """Has tyro parse without printing.

    Raises:
        ValueError: one line that says what is wrong.
        SystemExit: the help was asked for.
    """
    said = io.StringIO()
    try:
        with _without_terminal(said):
            return tyro.cli(kind, prog=_usage(program), args=list(arguments), **options)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        what = _sentence(said.getvalue()).removeprefix(f"{kind.__name__}: ")
        raise ValueError(f"{what}; see --help") from None


def start_jax() -> None:
    """Imports jax for a command; the library configures it when it is first used."""
    runtime.check_graphics()
    runtime.import_jax()


def complain(program: str, problem: str, status: int) -> int:
    """Prints a problem as one line; returns the status to exit with."""
    with contextlib.suppress(OSError):
        print(f"{program}: {' '.join(problem.split())}", file=sys.stderr)
    return status


def unforeseen(error: Exception, log: Path) -> WorkError:
    """An error that nobody foresaw: a line of it to raise, the rest in a file."""
    log.write_text("".join(traceback.format_exception(error)))
    reason = (str(error).splitlines() or [""])[0][:200]
    return WorkError(f"{type(error).__name__}: {reason} (details in {log})")


def script(main: Callable[[], None]) -> NoReturn:
    """Runs the main function of a script and ends the process with its status.

    An exception is one line, and its traceback lies in the file that the line names.
    """

    def work() -> int:
        main()
        return 0

    leave(_guarded(Path(sys.argv[0]).stem, work))


def leave(status: int) -> NoReturn:
    """Ends the process at once: XLA's threads can hold up an ordinary exit."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)


def _arguments(argv: Sequence[str] | None) -> list[str]:
    return list(sys.argv[1:] if argv is None else argv)


def _usage(program: str) -> str:
    """`dcc-jax motion import` of `dcc_jax.motion.import`."""
    return program.replace("_", "-").replace(".", " ")


def _guarded(program: str, work: Callable[[], int]) -> int:
    """The status of the work, whatever happens: nothing ends in a traceback."""
    with _streams_without_readers():
        try:
            return work()
        except KeyboardInterrupt:
            return complain(program, "interrupted", 1)
        except WorkError as failure:
            return complain(program, str(failure), 1)
        except SystemExit as stop:  # after the help, or a version of jax that hangs
            if isinstance(stop.code, str):
                return complain(program, stop.code, 1)
            return stop.code or 0
        except Exception as error:
            handle, log = tempfile.mkstemp(prefix=f"{program}-", suffix=".log")
            os.close(handle)
            return complain(program, str(unforeseen(error, Path(log))), 1)


@contextlib.contextmanager
def _without_terminal(said: TextIO) -> Iterator[None]:
    """tyro tells errors in boxes: here without colours, and with no line broken."""
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        with (
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            yield
    finally:
        del os.environ["COLUMNS"]
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _sentence(box: str) -> str:
    """What is wrong, out of the box that tyro draws around it.

    The box has a title, a rule, the text, and after another rule advice. Text that is
    indented further explains an option.
    """
    lines = [line for line in box.splitlines() if line.strip()]
    rules = [i for i, line in enumerate(lines) if not line.strip(" -─╭╮╰╯")]
    begin = rules[0] + 1 if rules else 0
    body = lines[begin : rules[1] if len(rules) > 1 else None]
    first, *others = [
        line.strip() for line in body if not line.startswith(10 * " ")
    ] or [""]
    if first.startswith("Missing from"):
        return f"missing: {', '.join(others)}"
    text = " ".join([first, *others]).removeprefix("Error parsing ").rstrip(".")
    # Of an option that may be None, what the other type says is what helps.
    return re.sub(r"no type matching .* - .*?: ", "", text)


@contextlib.contextmanager
def _streams_without_readers() -> Iterator[None]:
    """Output goes on where its reader has left (`| head`): nobody misses the rest."""
    with (
        contextlib.redirect_stdout(_Stream(sys.stdout)),  # pyright: ignore
        contextlib.redirect_stderr(_Stream(sys.stderr)),  # pyright: ignore
    ):
        yield


class _Stream:
    """A text stream that drops what it cannot deliver."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(BrokenPipeError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._stream.flush()
