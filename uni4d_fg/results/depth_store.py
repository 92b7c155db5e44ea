"""The fused depth of a run: one ``.npy`` (T, H, W) of float32 metres, never held in memory as a whole.

Frames are written with plain file writes and read back through a memory map. Writing through a memory map
would end the process without a message when the disk is full; a plain write raises an error instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_path, load_npy
from uni4d_fg.frontend.sequence.model import ArrayFrames


@dataclass
class DepthWriter:
    """Takes the depth maps of a video, in any order; made by :func:`write_depth`."""

    stream: BinaryIO
    start: int
    num_frames: int
    image_size: tuple[int, int]
    written: set[int] = field(default_factory=set)

    def write(self, frame: int, depth: npt.NDArray[np.floating]) -> None:
        """Store one map (H, W), metres; values that are not positive and finite are stored as NaN.

        Raises:
            ValueError: If the frame number or the size is not what was announced.
        """
        if not 0 <= frame < self.num_frames or depth.shape != self.image_size:
            raise ValueError(
                f"frame {frame} of size {depth.shape} does not fit {self.num_frames} frames of {self.image_size}"
            )
        with np.errstate(invalid="ignore"):
            stored = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan).astype("<f4")
        self.stream.seek(self.start + frame * stored.nbytes)
        self.stream.write(stored.tobytes())
        self.written.add(frame)


@contextmanager
def write_depth(path: Path, num_frames: int, image_size: tuple[int, int]) -> Iterator[DepthWriter]:
    """Write the depth of a video frame by frame; the file appears, whole, when the block ends normally.

    Args:
        path: The ``.npy`` file.
        num_frames: T.
        image_size: (height, width), px.

    Raises:
        OutputError: If it cannot be written.
        ValueError: If a frame was not written.
    """
    header = {"descr": "<f4", "fortran_order": False, "shape": (num_frames, *image_size)}
    with atomic_path(path) as temporary:
        with open(temporary, "wb") as stream:
            np.lib.format.write_array_header_1_0(stream, header)
            writer = DepthWriter(stream, stream.tell(), num_frames, image_size)
            yield writer
        if len(writer.written) != num_frames:
            absent = min(set(range(num_frames)) - writer.written)
            raise ValueError(f"{path}: depth of frame {absent} was not written")


def read_depth(path: Path) -> ArrayFrames:
    """Return the depth maps of a run as T frames (H, W), float32 metres, memory-mapped; NaN where missing.

    Raises:
        InputError: If the file is missing, damaged or not (T, H, W) float32.
    """
    array = load_npy(path, memory_map=True)
    if array.ndim != 3 or array.dtype != np.float32:
        raise InputError(f"{path}: holds {array.dtype} {array.shape}, expected float32 (T, H, W)")
    frames: Float32Array = array
    return ArrayFrames(frames)
