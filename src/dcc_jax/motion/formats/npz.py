"""Arrays in `.npz` archives: read without trusting the file, written reproducibly.

`numpy.load` allocates what a header claims before it looks at the data, and can be
told to unpickle. Here nothing is unpickled, and nothing is allocated that the archive
does not hold.
"""

from __future__ import annotations

import io
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

MAX_BYTES = 1 << 30
"""Unpacked size up to which an archive is read; an hour at 120 Hz is a tenth of it."""
MOST_PACKED = 200
"""Times by which motion may have been compressed; a still one comes to about 100."""
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the least time a zip can state


class MotionError(ValueError):
    """Bad motion data; its text is `FILE:LINE: reason` or `FILE: reason`."""

    def __init__(self, path: str | Path, reason: str, line: int | None = None) -> None:
        self.path, self.reason, self.line = str(path), reason, line
        where = self.path if line is None else f"{self.path}:{line}"
        super().__init__(" ".join(f"{where}: {reason}".split()))


def read_bytes(path: str | Path) -> bytes:
    """The whole file.

    Raises:
        MotionError: it cannot be read, or is larger than `MAX_BYTES`.
    """
    try:
        if os.path.getsize(path) > MAX_BYTES:
            raise MotionError(path, f"is larger than {MAX_BYTES >> 20} MiB")
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, MotionError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise MotionError(path, f"cannot be read: {reason}") from None


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an archive by name; objects (pickles) are refused.

    Raises:
        MotionError: no readable archive, a damaged member, or a member with objects.
    """
    data = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            bound = min(MAX_BYTES, max(1 << 24, MOST_PACKED * len(data)))
            if sum(member.file_size for member in members) > bound:
                raise MotionError(path, f"unpacks to more than {bound >> 20} MiB")
            return {
                member.filename.removesuffix(".npy"): _array(
                    path, member.filename, archive.read(member)
                )
                for member in members
            }
    except MotionError:
        raise
    except Exception as error:  # the standard parsers raise anything on hostile bytes
        raise MotionError(path, f"not a readable npz archive ({error})") from None


def _array(path: str | Path, name: str, data: bytes) -> np.ndarray:
    """The array in the bytes of one `.npy` member."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise MotionError(path, f"member {name!r} has unknown npy version {version}")
    shape, fortran, dtype = read_header(stream)
    if dtype.hasobject:
        raise MotionError(path, f"member {name!r} holds pickled objects; not loaded")
    rest = memoryview(data)[stream.tell() :]
    claimed = dtype.itemsize
    for extent in shape:
        claimed *= extent
    if claimed != len(rest):
        raise MotionError(
            path, f"member {name!r} claims {claimed} bytes but holds {len(rest)}"
        )
    return np.frombuffer(rest, dtype).reshape(shape, order="F" if fortran else "C")


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes an archive whose bytes depend on the arrays alone, all at once.

    The members are stored uncompressed, since compressors differ between versions.

    Raises:
        MotionError: the file cannot be written.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, arrays[name], (1, 0), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            info.external_attr = 0o644 << 16
            archive.writestr(info, member.getvalue())
    write_atomically(path, buffer.getvalue())


def write_atomically(path: str | Path, data: bytes) -> None:
    """Writes a file beside its place and renames it, so no half of it is ever seen.

    Raises:
        MotionError: the file cannot be written.
    """
    target = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=".partial-")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
            os.chmod(temporary, 0o644)
            os.replace(temporary, target)
        except BaseException:
            os.unlink(temporary)
            raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MotionError(path, f"cannot be written: {reason}") from None
