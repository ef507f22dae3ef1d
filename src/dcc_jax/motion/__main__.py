"""`python -m dcc_jax.motion import SRC... --out CLIP.npz`, and `inspect CLIP.npz`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from dcc_jax.motion.clip import Clip, load_clip, mirrored, save_clip
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import AXES, UNITS
from dcc_jax.motion.retarget import importer
from dcc_jax.motion.retarget.importer import FORMATS, Options, import_motion
from dcc_jax.motion.retarget.names import read_map
from dcc_jax.motion.retarget.quality import measure
from dcc_jax.motion.retarget.retarget import LOW_PASS, Retargeted


class _Parser(argparse.ArgumentParser):
    """A parser that complains in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {' '.join(message.split())}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; 0 on success, 2 on bad input."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except MotionError as error:
        print(error, file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="python -m dcc_jax.motion", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="{import,inspect}")
    _add_import(commands.add_parser("import", help="turn motion files into clips"))
    look = commands.add_parser("inspect", help="look at a clip")
    look.add_argument("clip", type=Path, metavar="CLIP.npz")
    look.add_argument("--plot", type=Path, metavar="FILE.png", help="a page of figures")
    look.add_argument("--video", type=Path, metavar="FILE.mp4")
    look.set_defaults(command=_inspect)
    return parser


def _add_import(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("sources", nargs="+", type=Path, metavar="SRC", help="motions, and .asf files")
    add(
        "--out",
        required=True,
        type=Path,
        metavar="CLIP.npz",
        help="the clip; a directory where there are several motions",
    )
    add("--format", default="auto", choices=("auto", *FORMATS))
    add("--fps", type=_rate, default=30.0, help="frame rate of the clip (30)")
    add("--source-fps", type=_rate, help="frame rate of the source, over what it says")
    add("--unit", choices=tuple(UNITS), help="unit of lengths, over what it says")
    add("--up", choices=AXES, help="the world's upward axis")
    add("--map", type=Path, metavar="FILE", help="lines 'body = joint' for odd names")
    add("--rest-frame", type=int, metavar="N", help="a frame that stands upright")
    add("--trim", type=_span, metavar="A:B", help="seconds of the source to take")
    add("--loop", action="store_true", help="cut and close the best loop in it")
    add("--mirror", action="store_true", help="write the mirrored clip as well")
    add("--low-pass", type=_cutoff, default=LOW_PASS, metavar="HZ", help="0: off (10)")
    add("--no-clean", action="store_true", help="leave the feet as they are")
    add("--name", help="name of the clip (the file's)")
    add("--label", help="the skill it shows")
    add("--licence", default="", help="terms of the source, kept in the clip")
    parser.set_defaults(command=_import)


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1.0 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not in [1, 1000] frames/s")
    return value


def _cutoff(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is neither 0 nor a frequency in Hz")
    return value


def _span(text: str) -> tuple[float, float]:
    start, colon, stop = text.partition(":")
    try:
        span = float(start or 0.0), float(stop or "inf")
    except ValueError:
        span = 0.0, 0.0
    if not colon or not 0.0 <= span[0] < span[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is not two times A:B with A < B")
    return span


def _import(arguments: argparse.Namespace) -> int:
    """Imports every motion among the sources; the bad ones do not stop the others."""
    options = Options(
        format=arguments.format,
        fps=arguments.fps,
        source_fps=arguments.source_fps,
        unit=arguments.unit,
        up=arguments.up,
        names=read_map(arguments.map) if arguments.map else None,
        rest_frame=arguments.rest_frame,
        trim=arguments.trim,
        loop=arguments.loop,
        low_pass=arguments.low_pass,
        clean=not arguments.no_clean,
    )
    skeletons = [path for path in arguments.sources if _is_skeleton(path)]
    motions = [path for path in arguments.sources if path not in skeletons]
    targets = _targets(motions, arguments)
    status = 0
    for path, target in _with_progress(list(zip(motions, targets, strict=True))):
        try:
            result = import_motion(path, options, skeletons)
            _save(target, result, arguments)
        except MotionError as error:
            print(error, file=sys.stderr)
            status = 2
        else:
            _report(path, target, result)
    return status


def _is_skeleton(path: Path) -> bool:
    try:
        return importer.detect_format(path) == "asf"
    except MotionError:
        return False  # it is named when its turn comes


def _targets(motions: list[Path], arguments: argparse.Namespace) -> list[Path]:
    """Where each clip goes.

    Raises:
        MotionError: there is no motion, or two clips would have one name.
    """
    out: Path = arguments.out
    if not motions:
        raise MotionError(arguments.sources[0], "a skeleton alone holds no motion")
    if len(motions) == 1 and out.suffix == ".npz" and not out.is_dir():
        return [out]
    if out.suffix == ".npz":
        raise MotionError(out, f"must be a directory for {len(motions)} motions")
    if arguments.name:
        raise MotionError(out, "--name is for one motion and a file CLIP.npz")
    stems = [path.stem for path in motions]
    targets = [
        out / f"{path.stem if stems.count(path.stem) == 1 else path.name}.npz"
        for path in motions
    ]
    for target in targets:
        if targets.count(target) > 1:
            raise MotionError(target, "two sources would be written to it")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MotionError(out, f"cannot be made: {error.strerror}") from None
    return targets


def _with_progress(jobs: list[tuple[Path, Path]]) -> Iterator[tuple[Path, Path]]:
    """The jobs, with a bar on stderr where there are several."""
    if len(jobs) == 1:
        yield from jobs
        return
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(jobs, "importing", console=console)


def _save(target: Path, result: Retargeted, arguments: argparse.Namespace) -> None:
    clip = replace(
        result.clip,
        name=arguments.name or result.clip.name,
        label=arguments.label,
        licence=arguments.licence,
    )
    save_clip(target, clip)
    if arguments.mirror:
        save_clip(target.with_stem(f"{target.stem}_mirrored"), mirrored(clip))


def _report(path: Path, target: Path, result: Retargeted) -> None:
    clip = result.clip
    loop = ", a loop" if clip.loop else ""
    print(
        f"{target}: {len(clip.qpos)} frames at {clip.fps:g} fps "
        f"({clip.duration:.2f} s{loop}) from {path.name}"
    )
    for note in result.notes:
        print(f"  note: {note}")
    print(f"  mean pose error against the source {result.pose_error:.2f} degrees")
    for before, after in zip(result.before.lines(), result.after.lines(), strict=True):
        print(f"  copied:  {before}\n  cleaned: {after}")


def _inspect(arguments: argparse.Namespace) -> int:
    clip = load_clip(arguments.clip)
    loop = ", a loop" if clip.loop else ""
    print(
        f"{clip.name}: {len(clip.qpos)} frames at {clip.fps:g} fps "
        f"({clip.duration:.2f} s{loop}), label {clip.label or '-'}"
    )
    print(f"  source: {clip.source or '-'}; licence: {clip.licence or '-'}")
    for line in measure(clip).lines():
        print(f"  {line}")
    if arguments.plot or arguments.video:
        _draw(clip, arguments)
    return 0


def _draw(clip: Clip, arguments: argparse.Namespace) -> None:
    """Writes the page of figures and the video that were asked for.

    Raises:
        MotionError: one of them cannot be written.
    """
    from dcc_jax.motion import inspect

    wanted = {inspect.plot: arguments.plot, inspect.video: arguments.video}
    for write, path in wanted.items():
        if path is None:
            continue
        try:
            write(clip, path)
        except (ValueError, OSError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise MotionError(path, f"cannot be written: {reason}") from None
        print(f"  wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
