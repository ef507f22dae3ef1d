"""Motion in numpy's files: which of the kinds of `.npz` it is, and pickles refused.

A pickle can run any code when it is loaded. It is never loaded here; what its owner can
type to turn it into an `.npz` is part of the refusal.
"""

from __future__ import annotations

from pathlib import Path

from dcc_jax.motion.formats.amass import is_amass, read_amass
from dcc_jax.motion.formats.mimickit import is_mimickit, read_mimickit
from dcc_jax.motion.formats.npz import MotionError, read_npz
from dcc_jax.motion.formats.poselib import read_poselib
from dcc_jax.motion.formats.skeleton import Motion

_POSELIB = (
    "import numpy as n;d=n.load('{0}.npy',allow_pickle=True).item();"
    "s=d['skeleton_tree'];n.savez('{0}.npz',fps=d['fps'],is_local=d['is_local'],"
    "node_names=s['node_names'],parent_indices=s['parent_indices']['arr'],"
    "local_translation=s['local_translation']['arr'],"
    "root_translation=d['root_translation']['arr'],rotation_xyzw=d['rotation']['arr'])"
)
_MIMICKIT = (
    "import numpy as n,pickle;d=pickle.load(open('{0}.pkl','rb'));"
    "n.savez('{0}.npz',frames=d['frames'],fps=d['fps'],"
    "loop=int(getattr(d['loop_mode'],'value',d['loop_mode'])))"
)


def is_archive(data: bytes) -> bool:
    """Whether a file that begins like this is one of numpy's, or a pickle."""
    return data.startswith((b"PK", b"\x93NUMPY", b"\x80"))


def read_archive(path: str | Path, fps: float | None = None) -> Motion:
    """Reads a motion of any kind that is kept in `.npz`.

    Args:
        path: the file.
        fps: its frame rate, if the caller knows it.

    Raises:
        MotionError: anything wrong with the file, or a pickle.
    """
    with open(path, "rb") as stream:
        head = stream.read(6)
    stem = Path(path).stem
    if head == b"\x93NUMPY":
        raise MotionError(path, _refusal("poselib", _POSELIB, stem))
    if head[:1] == b"\x80":
        raise MotionError(path, _refusal("MimicKit", _MIMICKIT, stem))
    arrays = read_npz(path)
    names = frozenset(arrays)
    if is_amass(names):
        return read_amass(path, arrays, fps)
    if is_mimickit(names):
        return read_mimickit(path, arrays)
    if "layout" in names and "qpos" in names:
        raise MotionError(path, "is a clip already: it needs no import")
    return read_poselib(path, arrays)


def _refusal(kind: str, program: str, stem: str) -> str:
    return (
        f"a pickle, which could run code, is not loaded; if it is a {kind} motion "
        f'and you trust it, convert it: python -c "{program.format(stem)}"'
    )
