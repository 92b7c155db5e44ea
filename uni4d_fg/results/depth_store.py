"""The fused depth of a run: one ``.npy`` (T, H, W) of float32 meters, never held in memory as a whole.

Frames are written with plain file writes and read back through a memory map.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array
from uni4d_fg.errors import InputError
from uni4d_fg.files import forget_pages, load_checksums, load_npy, npy_stream, write_checksums, write_failure
from uni4d_fg.frontend.sequence.model import ArrayFrames


@dataclass
class DepthWriter:
    """Takes the depth maps of a video, in any order; made by :func:`write_depth`."""

    stream: IO[bytes]
    start: int
    num_frames: int
    image_size: tuple[int, int]
    written: dict[int, int] = field(default_factory=dict)
    """Frame to the checksum of its map. Of frames that another process wrote, it says what they are."""

    def write(self, frame: int, depth: npt.NDArray[np.floating]) -> None:
        """Store one map (H, W), meters; values that are not positive and finite are stored as NaN.

        Raises:
            ValueError: If the frame number or the size is not what was announced.
        """
        if not 0 <= frame < self.num_frames or depth.shape != self.image_size:
            raise ValueError(
                f"frame {frame} of size {depth.shape} does not fit {self.num_frames} frames of {self.image_size}"
            )
        with np.errstate(invalid="ignore"):
            known = np.where((depth > 0.0) & (depth < np.inf), depth, np.float32(np.nan))
        stored = np.ascontiguousarray(known, dtype="<f4")
        self.stream.seek(self.start + frame * stored.nbytes)
        self.stream.write(stored.data)
        self.written[frame] = zlib.crc32(stored.data)

    def place(self) -> DepthPlace:
        """Return what another process of this machine needs to write some of the maps."""
        self.stream.flush()
        return DepthPlace(Path(self.stream.name), self.start, self.num_frames, self.image_size)


@dataclass(frozen=True)
class DepthPlace:
    """A file of depth that is being written."""

    path: Path
    start: int
    num_frames: int
    image_size: tuple[int, int]

    @contextmanager
    def opened(self) -> Iterator[DepthWriter]:
        """Write some of its maps; what :attr:`DepthWriter.written` then says, the file's own writer must be told.

        Raises:
            OutputError: If they cannot be written.
        """
        try:
            with open(self.path, "rb+") as stream:
                yield DepthWriter(stream, self.start, self.num_frames, self.image_size)
        except OSError as error:
            raise write_failure(self.path, error) from error


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
    with npy_stream(path, "<f4", (num_frames, *image_size)) as stream:
        writer = DepthWriter(stream, stream.tell(), num_frames, image_size)
        yield writer
        absent = set(range(num_frames)) - set(writer.written)
        if absent:
            raise ValueError(f"{path}: depth of frame {min(absent)} was not written")
        height, width = image_size
        stream.seek(writer.start + 4 * num_frames * height * width)
        write_checksums(stream, (writer.written[frame] for frame in range(num_frames)))


@dataclass(frozen=True)
class StoredDepth(ArrayFrames):
    """Memory-mapped depth maps; a map whose checksum does not fit raises InputError when it is read."""

    path: Path
    checksums: npt.NDArray[np.uint32] | None

    def __getitem__(self, frame: int) -> Float32Array:
        depth: Float32Array = np.array(self.array[frame])
        # Pages of a file that have been read count as this process's memory: 2.5 GB of 300 frames of 1080p.
        forget_pages(self.array)
        if self.checksums is not None and zlib.crc32(depth.data) != self.checksums[frame]:
            raise InputError(
                f"{self.path}: the depth of frame {frame % len(self)} is damaged, its checksum does not fit; make it "
                "again: run the same reconstruction with --resume"
            )
        return depth

    def __iter__(self) -> Iterator[Float32Array]:
        return (self[frame] for frame in range(len(self)))


def read_depth(path: Path, *, whole: bool = False) -> StoredDepth:
    """Return the depth maps of a run as T frames (H, W), float32 meters, memory-mapped; NaN where missing.

    Args:
        path: The ``depth.npy`` of the run.
        whole: Compare the checksums of all frames at once, and demand that there are some.

    Raises:
        InputError: If the file is missing, damaged or not (T, H, W) float32.
    """
    array = load_npy(path, memory_map=True)
    if array.ndim != 3 or array.dtype != np.float32:
        raise InputError(f"{path}: holds {array.dtype} {array.shape}, expected float32 (T, H, W)")
    checksums = load_checksums(path)
    if checksums is not None and len(checksums) != len(array):
        checksums = None
    if whole and checksums is None:
        raise InputError(f"{path}: has no checksums; make it again")
    frames = StoredDepth(array, path, checksums)
    for _ in frames if whole else ():
        pass
    return frames
