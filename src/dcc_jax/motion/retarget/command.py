"""`dcc-jax motion import SRC... --out CLIP.npz`: motion files into clips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from dcc_jax import command
from dcc_jax.motion.clip import mirrored, save_clip
from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import AXES, UNITS
from dcc_jax.motion.retarget import importer
from dcc_jax.motion.retarget.batch import Batch, make_batch
from dcc_jax.motion.retarget.importer import FORMATS, import_motion
from dcc_jax.motion.retarget.names import read_map
from dcc_jax.motion.retarget.retarget import LOW_PASS, Retargeted
from dcc_jax.motion.retarget.sides import SIDES
from dcc_jax.motion.retarget.verdict import verdict

PROGRAM = "dcc_jax.motion.import"
_AS_FILE = "(default: what the file says)"


@dataclass(frozen=True)
class Options:
    """Turns motion files into clips of the character.

    The good files are imported even where others are bad.

    Exit status: 0 done; 2 a bad argument or file; 1 a failure."""

    sources: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="SRC [SRC ...]", help_behavior_hint="(required)"),
    ]
    """Motions, and .asf files."""

    out: Annotated[Path, arg(metavar="CLIP.npz")]
    """The clip; a directory where there are several motions."""

    format: Annotated[str, arg(metavar="|".join(("auto", *FORMATS)))] = "auto"
    """Of the sources."""

    fps: Annotated[float, arg(metavar="HZ")] = 30.0
    """Frame rate of the clip."""

    source_fps: Annotated[
        float | None, arg(metavar="HZ", help_behavior_hint=_AS_FILE)
    ] = None
    """Frame rate of the source."""

    unit: Annotated[
        str | None,
        arg(metavar="|".join(UNITS), help_behavior_hint="(default: the legs tell it)"),
    ] = None
    """Unit of lengths; refuses a figure that would be a giant or a dwarf."""

    up: Annotated[
        str | None,
        arg(metavar="|".join(AXES), help_behavior_hint="(default: found out)"),
    ] = None
    """The world's upward axis."""

    map: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: found out)")
    ] = None
    """Lines 'body = joint' for odd names."""

    root: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: the figure)")
    ] = None
    """The ROOT of a BVH file with several figures."""

    sides: Annotated[str, arg(metavar="|".join(SIDES))] = "keep"
    """Swaps left and right, or mirrors left-handed axes."""

    rest_frame: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: the zero pose)")
    ] = None
    """A frame that stands upright."""

    trim: Annotated[
        str | None, arg(metavar="A:B", help_behavior_hint="(default: all)")
    ] = None
    """Seconds of the source to take."""

    loop: FlagCreatePairsOff[bool] = False
    """Cuts and closes the best loop in it."""

    mirror: FlagCreatePairsOff[bool] = False
    """Writes the mirrored clip as well."""

    low_pass: Annotated[float, arg(metavar="HZ")] = LOW_PASS
    """Smooths what was recorded faster than 60 Hz; 0: off."""

    no_clean: FlagCreatePairsOff[bool] = False
    """Leaves the feet as they are."""

    name: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: the file's)")
    ] = None
    """Name of the clip."""

    label: Annotated[
        str | None, arg(metavar="SKILL", help_behavior_hint="(default: none)")
    ] = None
    """The skill it shows."""

    licence: Annotated[
        str, arg(metavar="TEXT", help_behavior_hint="(default: none)")
    ] = ""
    """Terms of the source, kept in the clip."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("missing: SRC")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    read = partial(command.parse, PROGRAM, Options)
    return command.run(PROGRAM, argv, read, _prepare)


def _prepare(options: Options) -> command.Work:
    how = importer.Options(
        format=options.format,
        fps=options.fps,
        source_fps=options.source_fps,
        unit=options.unit,
        up=options.up,
        names=read_map(options.map) if options.map else None,
        root=options.root,
        sides=options.sides,
        rest_frame=options.rest_frame,
        trim=None if options.trim is None else importer.read_span(options.trim),
        loop=options.loop,
        low_pass=options.low_pass,
        clean=not options.no_clean,
    )
    batch = make_batch(options.sources, options.out, named=bool(options.name))
    return partial(_import, batch, how, options)


def _import(batch: Batch, how: importer.Options, options: Options) -> int:
    """Imports every motion; a bad one does not stop the others."""
    status = 0
    for path, target in _with_progress(batch.motions):
        try:
            result = import_motion(path, how, batch.skeletons)
            _save(target, result, options)
        except MotionError as error:
            status = command.complain(PROGRAM, str(error), 2)
        else:
            _report(path, target, result)
    return status


def _with_progress(jobs: list[tuple[Path, Path]]) -> Iterator[tuple[Path, Path]]:
    """The jobs, with a bar on stderr where there are several."""
    if len(jobs) == 1:
        yield from jobs
        return
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(jobs, "importing", console=console)


def _save(target: Path, result: Retargeted, options: Options) -> None:
    clip = replace(
        result.clip,
        name=options.name or result.clip.name,
        label=options.label,
        licence=options.licence,
    )
    save_clip(target, clip)
    if options.mirror:
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
    print(f"  {verdict(result.doubts)}")
