"""Films as files: H.264 videos and gifs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

GIF_COLOURS = 128


def write_film(path: str | Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Writes images [height, width, 3] uint8 as an mp4 or a gif, by the path's ending.

    Raises:
        ModuleNotFoundError: an mp4 needs the `video` extra.
        OSError: there is no ffmpeg, or the file cannot be written.
    """
    if Path(path).suffix.lower() == ".gif":
        write_gif(path, images, fps)
    else:
        write_mp4(path, iter(images), fps)


def write_gif(path: str | Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Writes images [height, width, 3] uint8 as a picture that loops.

    Its colours are those of the first image, which keeps still parts still.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    pictures = [Image.fromarray(image) for image in images]
    palette = pictures[0].quantize(GIF_COLOURS, dither=Image.Dither.NONE)
    first, *others = (
        p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures
    )
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=1000.0 / fps,
        loop=0,
        optimize=True,
    )


def check_video(path: str | Path) -> None:
    """Finds out before the work whether `write_mp4` can write a video.

    Raises:
        ModuleNotFoundError: the `video` extra is not installed.
        OSError: there is no ffmpeg, or the folder cannot be written to.
    """
    try:
        import imageio.v2  # noqa: F401
        import imageio_ffmpeg
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"writing {path} needs {error.name}: pip install 'dcc-jax[video]'"
        ) from None
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise OSError(f"writing {path} needs ffmpeg: {error}") from None
    if not os.access(Path(path).parent, os.W_OK):
        raise PermissionError(f"{path} cannot be written there: choose another place")


def write_mp4(path: str | Path, images: Iterator[np.ndarray], fps: float) -> None:
    """Writes images [height, width, 3] uint8 as an H.264 video.

    Raises:
        ModuleNotFoundError: the `video` extra is not installed.
        OSError: there is no ffmpeg, or the file cannot be written.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    check_video(path)
    import imageio.v2 as imageio

    with warnings.catch_warnings():
        # jax warns of any child process; ffmpeg shares nothing with it.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
        writer: Any = imageio.get_writer(
            path, fps=fps, codec="libx264", quality=8, macro_block_size=2
        )
        with writer:
            for image in images:
                writer.append_data(image)
