"""How sure the static depth of a run is: one ``.npy`` (T, h, w) of 8 bits, at the size at which static depth is made.

0 says nothing is known (something moves, or depth is missing), 255 that it is certain to be right to 3 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npy, npy_stream
from uni4d_fg.frontend.sequence.model import ArrayFrames

_STEPS = 255


@dataclass
class ConfidenceWriter:
    """Takes the maps of a video, in order; made by :func:`write_confidence`."""

    stream: IO[bytes]
    size: tuple[int, int]
    written: int = 0

    def write(self, confidence: Float32Array) -> None:
        """Store the next map (h, w), 0 to 1. Raises ValueError if its size is not what was announced."""
        self.write_steps(in_steps(confidence))

    def write_steps(self, steps: ImageArray) -> None:
        """Store the next map (h, w) as :func:`in_steps` gives it. Raises as :meth:`write`."""
        if steps.shape != self.size:
            raise ValueError(f"a map of size {steps.shape} does not fit {self.size}")
        self.stream.write(steps.tobytes())
        self.written += 1


def in_steps(confidence: Float32Array) -> ImageArray:
    """Return a map (h, w) of 0 to 1 as it is stored, in 8 bits."""
    return np.asarray(np.rint(np.clip(confidence, 0, 1) * _STEPS), dtype=np.uint8)


@contextmanager
def write_confidence(path: Path, num_frames: int, size: tuple[int, int]) -> Iterator[ConfidenceWriter]:
    """Write maps frame by frame; the file appears, whole, when the block ends normally.

    Args:
        path: The ``.npy`` file.
        num_frames: T.
        size: (h, w).

    Raises:
        OutputError: If it cannot be written.
        ValueError: If a frame was not written.
    """
    with npy_stream(path, "|u1", (num_frames, *size)) as stream:
        writer = ConfidenceWriter(stream, size)
        yield writer
        if writer.written != num_frames:
            raise ValueError(f"{path}: {writer.written} of {num_frames} frames were written")


@dataclass(frozen=True)
class StoredConfidence(ArrayFrames):
    """Memory-mapped maps, given at the size of the images."""

    image_size: tuple[int, int]

    def __getitem__(self, frame: int) -> Float32Array:
        height, width = self.image_size
        enlarged = cv2.resize(self.array[frame], (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(enlarged, dtype=np.float32) / np.float32(_STEPS)

    def __iter__(self) -> Iterator[Float32Array]:
        return (self[frame] for frame in range(len(self)))


def read_confidence(path: Path, image_size: tuple[int, int]) -> StoredConfidence:
    """Return T maps (H, W), the probability that static depth is right to 3 %.

    Args:
        path: The ``confidence.npy`` of the run.
        image_size: (H, W), px.

    Raises:
        InputError: If the file is missing, damaged or not (T, h, w) of 8 bits.
    """
    array = load_npy(path, memory_map=True)
    if array.ndim != 3 or array.dtype != np.uint8:
        raise InputError(f"{path}: holds {array.dtype} {array.shape}, expected uint8 (T, h, w)")
    return StoredConfidence(array, image_size)
