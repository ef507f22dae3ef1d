"""`dcc-jax motion inspect CLIP.npz`: what is in a clip, in numbers and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from dcc_jax import command

if TYPE_CHECKING:
    from dcc_jax.motion.clip import Clip

PROGRAM = "dcc_jax.motion.inspect"


@dataclass(frozen=True)
class Options:
    """Measures a clip, and draws it.

    Exit status: 0 done; 2 a bad argument or file; 1 a failure."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP.npz")]
    """The clip."""

    plot: Annotated[
        Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")
    ] = None
    """Writes a page of figures."""

    video: Annotated[
        Path | None, arg(metavar="FILE.mp4", help_behavior_hint="(default: none)")
    ] = None
    """Writes a video."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    read = partial(command.parse, PROGRAM, Options)
    return command.run(PROGRAM, argv, read, _prepare)


def _prepare(options: Options) -> command.Work:
    from dcc_jax.motion.clip import load_clip

    return partial(_inspect, load_clip(options.clip), options)


def _inspect(clip: Clip, options: Options) -> int:
    from dcc_jax.motion.retarget.quality import measure
    from dcc_jax.motion.retarget.verdict import doubts, verdict

    quality = measure(clip)
    print(verdict(doubts(clip, quality)))
    loop = ", a loop" if clip.loop else ""
    print(
        f"{clip.name}: {len(clip.qpos)} frames at {clip.fps:g} fps "
        f"({clip.duration:.2f} s{loop}), label {clip.label or '-'}"
    )
    print(f"  source: {clip.source or '-'}; licence: {clip.licence or '-'}")
    for line in quality.lines():
        print(f"  {line}")
    return _draw(clip, options) if options.plot or options.video else 0


def _draw(clip: Clip, options: Options) -> int:
    """Writes the page of figures and the video that were asked for."""
    from dcc_jax.motion import inspect

    wanted = {inspect.plot: options.plot, inspect.video: options.video}
    for write, path in wanted.items():
        if path is None:
            continue
        try:
            write(clip, path)
        # ModuleNotFoundError: the video extra is not installed.
        except (ValueError, OSError, ModuleNotFoundError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            return command.complain(PROGRAM, f"{path}: cannot be written: {reason}", 2)
        print(f"  wrote {path}")
    return 0
