"""Several motion files into clips: which are motions, and where each clip goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.retarget.importer import detect_format


@dataclass(frozen=True)
class Batch:
    """Files to import."""

    motions: list[tuple[Path, Path]]  # source, clip
    skeletons: list[Path]  # .asf files, for the motions that need one


def make_batch(sources: Sequence[Path], out: Path, named: bool) -> Batch:
    """Sorts the sources, and makes the directory of the clips.

    Args:
        sources: motions, and `.asf` files.
        out: the clip `*.npz`; a directory where there are several motions.
        named: the clip was given a name, so there can be but one.

    Raises:
        MotionError: there is no motion, or two clips would have one name.
    """
    skeletons = [path for path in sources if _is_skeleton(path)]
    motions = [path for path in sources if path not in skeletons]
    if not motions:
        raise MotionError(sources[0], "a skeleton alone holds no motion")
    targets = _targets(motions, out, named)
    return Batch(list(zip(motions, targets, strict=True)), skeletons)


def _is_skeleton(path: Path) -> bool:
    try:
        return detect_format(path) == "asf"
    except MotionError:
        return False  # it is named when its turn comes


def _targets(motions: list[Path], out: Path, named: bool) -> list[Path]:
    if len(motions) == 1 and out.suffix == ".npz" and not out.is_dir():
        return [out]
    if out.suffix and out.suffix != ".npz" and not out.is_dir():
        raise MotionError(out, "a clip ends in .npz; `motion export` writes BVH")
    if out.suffix == ".npz":
        raise MotionError(out, f"must be a directory for {len(motions)} motions")
    if named:
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
