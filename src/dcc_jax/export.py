"""`dcc-jax motion export WHAT --out FILE.bvh`: a clip or a policy's motion as BVH."""

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

PROGRAM = "dcc_jax.motion.export"


@dataclass(frozen=True)
class Options:
    """Writes a clip, or what a trained policy does, as BVH for Blender and the like.

    Exit status: 0 done; 2 a bad argument or file; 1 a failure."""

    source: Annotated[Positional[str], arg(metavar="CLIP.npz|RUN_DIR|NAME")]
    """A clip, a run directory, or the name of a clip or policy that ships."""

    out: Annotated[Path, arg(metavar="FILE.bvh")]
    """The BVH file."""

    seconds: Annotated[float, arg(metavar="S")] = 8.0
    """Length of what a policy does."""

    alpha: Annotated[
        float | None,
        arg(metavar="A", help_behavior_hint="(default: the greatest of the training)"),
    ] = None
    """Level of compliance of the policy."""

    seed: Annotated[int, arg(metavar="N")] = 0
    """Of everything that is drawn for the policy."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    read = partial(command.parse, PROGRAM, Options)
    return command.run(PROGRAM, argv, read, _prepare)


def _prepare(options: Options) -> command.Work:
    if options.out.suffix.lower() != ".bvh":
        raise ValueError(f"--out must end in .bvh, got {options.out}")
    clip = _clip(options.source)
    if clip is None:
        clip = _played(options)
    return partial(_write, clip, options.out)


def _clip(source: str) -> Clip | None:
    """The clip of that name; None: it is no clip's."""
    from dcc_jax.character import asset_path
    from dcc_jax.motion.clip import load_clip

    if source.endswith(".npz"):
        return load_clip(source)
    if Path(source).exists():
        return None
    try:
        return load_clip(asset_path(f"motions/{source}.npz"))
    except FileNotFoundError:
        return None


def _played(options: Options) -> Clip:
    """What the policy does in its first episode."""
    if not 0.1 <= options.seconds <= 3600.0:
        raise ValueError(f"seconds must be in [0.1, 3600], got {options.seconds}")
    command.start_jax()
    import numpy as np

    from dcc_jax.env.config import CONTROL_RATE
    from dcc_jax.motion.clip import Clip, join_qpos, split_qpos
    from dcc_jax.play.player import Player
    from dcc_jax.play.runs import find_run, make_environment

    run = find_run(options.source)
    if options.alpha is not None:
        run.config.env.compliance.check_alpha(options.alpha)
    environment = make_environment(run)
    alpha = run.alphas[1] if options.alpha is None else options.alpha
    recording = Player(environment).play(
        run, [0], [alpha], seed=options.seed, seconds=options.seconds, motion=True
    )
    assert recording.motion is not None
    alive = recording.alive[:, 0]
    character_qpos = environment.scene.character_qpos(recording.motion.qpos)
    qpos = np.asarray(character_qpos)[alive, 0]
    if len(qpos) < 2:
        raise ValueError(f"{run.name} falls at once: nothing to write")
    frames = join_qpos(*split_qpos(qpos))
    return Clip(frames, CONTROL_RATE, run.name, f"policy {run.name}, alpha {alpha:g}")


def _write(clip: Clip, out: Path) -> None:
    from dcc_jax.motion.retarget.bvh_writer import write_bvh

    out.parent.mkdir(parents=True, exist_ok=True)
    write_bvh(out, clip)
    print(f"{out}: {len(clip.qpos)} frames at {clip.fps:g} fps ({clip.duration:.2f} s)")


if __name__ == "__main__":
    command.leave(main())
