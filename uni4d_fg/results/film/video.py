"""Films as files: MP4 that browsers and phones play, and GIF."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from PIL import Image

from uni4d_fg.arrays import ImageArray
from uni4d_fg.errors import OutputError
from uni4d_fg.files import atomic_path

_QUALITY = "20"
_GIF_COLORS = 128
_GIF_WIDTH = 640


class Film(Protocol):
    """Takes pictures one after another."""

    def add(self, picture: ImageArray) -> None:
        """Add a picture (H, W, 3), RGB, of the size that the film was opened with."""


def find_ffmpeg() -> str | None:
    """Return a program that writes H.264: that of the package imageio-ffmpeg, else one on the path, else None."""
    try:
        found: str = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")
    return found


@contextmanager
def open_mp4(path: Path, size: tuple[int, int], frames_per_second: float) -> Iterator[Film]:
    """Write an MP4, whole or not at all: H.264 where a program for it is found, else VP9 by OpenCV.

    Args:
        path: The ``.mp4`` file.
        size: (height, width) of the pictures, even, px.
        frames_per_second: Speed.

    Raises:
        OutputError: If the file cannot be written.
    """
    program = find_ffmpeg()
    with atomic_path(path) as temporary:
        film: _OpenCvFilm | _FfmpegFilm
        if program is None:
            film = _OpenCvFilm(temporary, size, frames_per_second)
        else:
            film = _FfmpegFilm(program, temporary, size, frames_per_second)
        try:
            yield film
        except BaseException:
            film.abandon()
            raise
        film.close()


@contextmanager
def open_gif(path: Path, frames_per_second: float) -> Iterator[Film]:
    """Write a GIF that repeats, whole or not at all, at most 640 px wide.

    Raises:
        OutputError: If the file cannot be written.
    """
    film = _GifFilm()
    yield film
    with atomic_path(path) as temporary:
        film.save(temporary, frames_per_second)


class _FfmpegFilm:
    def __init__(self, program: str, path: Path, size: tuple[int, int], frames_per_second: float) -> None:
        height, width = size
        self._path = path
        self._process = subprocess.Popen(
            [
                program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
                "-r", f"{frames_per_second:g}", "-i", "-", "-an", "-c:v", "libx264", "-preset", "medium", "-crf",
                _QUALITY, "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path),
            ],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def add(self, picture: ImageArray) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(picture).tobytes())
        except BrokenPipeError:
            self._fail()

    def close(self) -> None:
        _, error = self._process.communicate()
        if self._process.returncode:
            raise OutputError(f"cannot write {self._path.name}: ffmpeg: {_last_line(error)}")

    def abandon(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _fail(self) -> None:
        assert self._process.stderr is not None
        error = self._process.stderr.read()
        raise OutputError(f"cannot write the film: ffmpeg: {_last_line(error)}")


class _OpenCvFilm:
    def __init__(self, path: Path, size: tuple[int, int], frames_per_second: float) -> None:
        height, width = size
        self._path, self._count = path, 0
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), frames_per_second, (width, height))
        if not self._writer.isOpened():
            raise OutputError(
                "this OpenCV cannot write VP9, and there is no ffmpeg: run `pip install 'uni4d-fg[render]'`"
            )

    def add(self, picture: ImageArray) -> None:
        self._writer.write(np.ascontiguousarray(picture[..., ::-1]))
        self._count += 1

    def close(self) -> None:
        self._writer.release()
        # OpenCV says nothing of a disk that is full: the file then has no index, or ends early.
        written = cv2.VideoCapture(str(self._path))
        found = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
        written.release()
        if found != self._count:
            raise OutputError(
                f"cannot write {self._path.name}: {found} of {self._count} pictures can be read again; check free space"
            )

    def abandon(self) -> None:
        self._writer.release()


class _GifFilm:
    def __init__(self) -> None:
        self._pictures: list[Image.Image] = []

    def add(self, picture: ImageArray) -> None:
        height, width = picture.shape[:2]
        if width > _GIF_WIDTH:
            size = _GIF_WIDTH, max(1, round(height * _GIF_WIDTH / width))
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        image = Image.fromarray(picture)
        self._pictures.append(image.quantize(_GIF_COLORS, dither=Image.Dither.NONE))

    def save(self, path: Path, frames_per_second: float) -> None:
        # The format counts in hundredths of a second.
        duration = max(20, round(100.0 / frames_per_second) * 10)
        first, *rest = self._pictures
        first.save(path, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0)


def _last_line(error: bytes) -> str:
    lines = error.decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines else "failed without a message"
