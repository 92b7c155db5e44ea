"""Label maps of a long video in little memory: compressed one by one, decoded when asked for."""

from __future__ import annotations

import zlib

import numpy as np

from uni4d_fg.arrays import Int32Array
from uni4d_fg.frontend.sequence.frames import LazyFrames


class CompressedLabels(LazyFrames[Int32Array]):
    """A growing list of (H, W) int32 label maps; a map of a few regions takes a few kilobytes.

    Args:
        size: (height, width) of every map.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._frames: list[bytes] = []
        self._renamed: Int32Array | None = None

    def append(self, labels: Int32Array) -> None:
        """Add a map of the next frame."""
        if labels.shape != self.size:
            raise ValueError(f"labels have shape {labels.shape}, not {self.size}")
        self._frames.append(zlib.compress(np.ascontiguousarray(labels, np.int32).tobytes(), 1))

    def rename(self, new_ids: Int32Array) -> None:
        """Let id n read as ``new_ids[n]`` from now on; ``new_ids[0]`` must be 0."""
        self._renamed = new_ids.astype(np.int32)

    def __len__(self) -> int:
        return len(self._frames)

    def where(self, frame: int) -> str:
        """Return the frame number; there is no file."""
        return f"mask of frame {frame}"

    def _read(self, frame: int) -> Int32Array:
        labels = np.frombuffer(zlib.decompress(self._frames[frame]), np.int32).reshape(self.size)
        return labels.copy() if self._renamed is None else self._renamed[labels]
