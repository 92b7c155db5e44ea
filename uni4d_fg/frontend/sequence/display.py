"""How stored pixels of a video file are shown: mirrored or turned, and stretched until pixels are square.

The decoder turns pictures as the rotation in the file says, but takes a mirroring display matrix for a rotation and
leaves pixels that are not square as they are. Both are mended here. In a track header of an ISO base media file (MP4,
MOV) the matrix maps stored (x, y) to shown (a x + c y, b x + d y), with y down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray

_MAX_BOXES = 1000
"""Boxes of one level that are looked at; a file with more is damaged."""
_MAX_ASPECT = 4.0
"""Pixels that are longer than this are taken for a wrong entry."""
_MATRIX_AT = {0: 40, 1: 52}
"""Where the matrix of a track header begins in its content, by version."""

_MIRRORED: dict[tuple[int, int, int, int], Callable[[ImageArray], ImageArray]] = {
    (-1, 0, 0, 1): lambda image: image[:, ::-1],
    (1, 0, 0, -1): lambda image: image[::-1],
    (0, 1, 1, 0): lambda image: image.swapaxes(0, 1),
    (0, -1, -1, 0): lambda image: image[::-1, ::-1].swapaxes(0, 1),
}
"""From a, b, c, d to the picture that is shown."""


@dataclass(frozen=True)
class Display:
    """What is done to every decoded picture of a file."""

    mirror: tuple[int, int, int, int] | None = None
    """Display matrix a, b, c, d where it mirrors; None where the decoder's rotation is right."""
    pixel_aspect: float = 1.0
    """Width over height of a decoded pixel."""

    def apply(self, image: ImageArray) -> ImageArray:
        """Return a decoded picture (H, W, 3) as it is to be seen, of square pixels; no sample is thrown away."""
        if self.mirror is not None:
            image = _MIRRORED[self.mirror](image)
        if self.pixel_aspect == 1.0:
            return np.ascontiguousarray(image)
        height, width = image.shape[:2]
        width, height = round(width * max(self.pixel_aspect, 1.0)), round(height / min(self.pixel_aspect, 1.0))
        return np.asarray(
            cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8
        )


def display_of(path: Path, stored_aspect: float, rotation: float) -> Display:
    """Return how a video file is to be shown.

    Args:
        path: The file.
        stored_aspect: Width over height of a stored pixel, as the decoder says; 0 where it does not.
        rotation: Degrees by which the decoder turns pictures.
    """
    mirror = mirroring_matrix(path)
    turned = mirror[0] == 0 if mirror is not None else round(rotation / 90.0) % 2 == 1
    known = np.isfinite(stored_aspect) and 1.0 / _MAX_ASPECT <= stored_aspect <= _MAX_ASPECT
    aspect = float(stored_aspect) if known else 1.0
    return Display(mirror, 1.0 / aspect if turned else aspect)


def mirroring_matrix(path: Path) -> tuple[int, int, int, int] | None:
    """Return a, b, c, d of a video track's display matrix if it mirrors; None for any other file or matrix."""
    try:
        with open(path, "rb") as stream:
            return next((m for m in _video_matrices(stream, path.stat().st_size) if m in _MIRRORED), None)
    except OSError:
        return None


def _video_matrices(stream: IO[bytes], size: int) -> Iterator[tuple[int, int, int, int]]:
    """Return the display matrix of every video track, in whole numbers."""
    for track in _find(stream, 0, size, b"moov", b"trak"):
        kinds = []
        for start, _ in _find(stream, *track, b"mdia", b"hdlr"):
            stream.seek(start + 8)
            kinds.append(stream.read(4))
        for start, end in _find(stream, *track, b"tkhd"):
            stream.seek(start)
            header = stream.read(min(end - start, 100))
            at = _MATRIX_AT.get(header[0]) if header else None
            if at is None or len(header) < at + 20 or b"vide" not in kinds:
                continue
            a, b, c, d = (
                int.from_bytes(header[at + i : at + i + 4], "big", signed=True) / 65536.0 for i in (0, 4, 12, 16)
            )
            yield round(a), round(b), round(c), round(d)


def _find(stream: IO[bytes], start: int, end: int, *names: bytes) -> Iterator[tuple[int, int]]:
    """Return where the content of each box begins and ends on the way down a path of names."""
    if not names:
        yield start, end
        return
    position = start
    for _ in range(_MAX_BOXES):
        if position + 8 > end:
            return
        stream.seek(position)
        header = stream.read(16)
        length, content = int.from_bytes(header[:4], "big"), position + 8
        if length == 1:
            length, content = int.from_bytes(header[8:16], "big"), position + 16
        elif length == 0:
            length = end - position
        if length < content - position:
            return
        if header[4:8] == names[0]:
            yield from _find(stream, content, min(position + length, end), *names[1:])
        position += length
