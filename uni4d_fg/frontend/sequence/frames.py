"""Lazy per-frame sources: a file is opened when its frame is asked for, and nothing is kept."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array, IntArray
from uni4d_fg.files import load_npy
from uni4d_fg.frontend.sequence.decode import clean_depth, read_depth, read_image, read_mask
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import SequenceProblem

T = TypeVar("T", bound=npt.NDArray[Any])


class LazyFrames(ABC, Generic[T]):
    """A :class:`~uni4d_fg.frontend.sequence.model.FrameSource` that reads a frame each time it is indexed."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def _read(self, frame: int) -> T:
        """Return frame ``frame`` in [0, T). Raises InputError if it cannot be read."""

    @abstractmethod
    def where(self, frame: int) -> str:
        """Return the file (and place in it) that frame ``frame`` comes from, for messages."""

    def __getitem__(self, frame: int) -> T:
        index = operator.index(frame)
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {frame} of a video of {len(self)} frames")
        return self._read(index % len(self))

    def __iter__(self) -> Iterator[T]:
        return (self._read(frame) for frame in range(len(self)))


class FileFrames(LazyFrames[T]):
    """One file per frame; every frame must have the size of the video's first image.

    Args:
        paths: T files.
        size: Expected (height, width); None takes the first file's, which is decoded at once.

    Attributes:
        paths: T files.
        size: (height, width), px.

    Raises:
        InputError: On construction without ``size``, and on indexing, if a file cannot be decoded; on
            indexing if its size differs.
    """

    def __init__(self, paths: tuple[Path, ...], size: tuple[int, int] | None = None) -> None:
        self.paths = paths
        self.size: tuple[int, int]
        if size is None:
            shape = self._decode(paths[0]).shape
            size = (shape[0], shape[1])
        self.size = size

    @abstractmethod
    def _decode(self, path: Path) -> T:
        """Return the content of one file."""

    def __len__(self) -> int:
        return len(self.paths)

    def where(self, frame: int) -> str:
        """Return the file of frame ``frame``."""
        return str(self.paths[frame])

    def _read(self, frame: int) -> T:
        array = self._decode(self.paths[frame])
        if array.shape[:2] != self.size:
            found = (array.shape[0], array.shape[1])
            raise _wrong_size(self.paths[frame], found, self.size, is_cue=not isinstance(self, ImageFolder))
        return array


class ImageFolder(FileFrames[ImageArray]):
    """T image files as (H, W, 3) uint8 RGB."""

    def _decode(self, path: Path) -> ImageArray:
        return read_image(path)


class MaskFolder(FileFrames[Int32Array]):
    """T label files (PNG or ``.npy``) as (H, W) int32 ids, 0 = static."""

    def _decode(self, path: Path) -> Int32Array:
        return read_mask(path)


class DepthFolder(FileFrames[Float32Array]):
    """T depth files (16-bit PNG, or ``.npy`` in meters) as (H, W) float32 meters, NaN where missing.

    Args:
        paths: T files.
        size: Expected (height, width); None takes the first file's.
        units_per_meter: Divisor that turns PNG values into meters.
    """

    def __init__(
        self, paths: tuple[Path, ...], size: tuple[int, int] | None = None, units_per_meter: float = 1000.0
    ) -> None:
        self.units_per_meter = units_per_meter
        super().__init__(paths, size)

    def _decode(self, path: Path) -> Float32Array:
        return read_depth(path, self.units_per_meter)


class NpyDepth(LazyFrames[Float32Array]):
    """Depth maps of one ``.npy`` file, mapped into memory only while a frame is copied out of it.

    Args:
        path: File of (T, H, W) or (T, 1, H, W) floats in meters.
        size: Expected (height, width); None accepts any.

    Attributes:
        path: The file.
        size: (height, width), px.

    Raises:
        InputError: If the file cannot be read, has another shape or does not hold floats.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.path = path
        values = load_npy(path, memory_map=True)
        if values.ndim not in (3, 4) or (values.ndim == 4 and values.shape[1] != 1):
            raise SequenceProblem(path, f"has shape {values.shape}", "save depth as (T, H, W) or (T, 1, H, W)")
        if values.dtype.kind != "f":
            raise SequenceProblem(
                path, f"holds {values.dtype} values of unknown unit", "save depth as floats in meters"
            )
        self.size = (int(values.shape[-2]), int(values.shape[-1]))
        self._length = int(values.shape[0])
        if size is not None and self.size != size:
            raise _wrong_size(path, self.size, size)

    def __len__(self) -> int:
        return self._length

    def where(self, frame: int) -> str:
        """Return the file and frame number."""
        return f"{self.path} [frame {frame}]"

    def _read(self, frame: int) -> Float32Array:
        values = load_npy(self.path, memory_map=True)
        if values.shape[0] != self._length or values.shape[-2:] != self.size:
            raise SequenceProblem(self.path, "was changed while it was in use", "start again")
        return clean_depth(values[frame].reshape(self.size))


class SelectedFrames(LazyFrames[T]):
    """Some frames of another source.

    Args:
        source: The source.
        frames: (N,) frames of it, in any order.
    """

    def __init__(self, source: FrameSource[T], frames: IntArray) -> None:
        self.source = source
        self.frames = frames

    def __len__(self) -> int:
        return len(self.frames)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, int(self.frames[frame]))

    def _read(self, frame: int) -> T:
        return self.source[int(self.frames[frame])]


class ChangedFrames(LazyFrames[T]):
    """The frames of another source, each changed when it is read.

    Args:
        source: T frames.
        change: Makes one frame of one of the source.
    """

    def __init__(self, source: FrameSource[T], change: Callable[[T], T]) -> None:
        self.source = source
        self.change = change

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> T:
        return self.change(self.source[frame])


def where_of(source: FrameSource[Any], frame: int) -> str:
    """Return where a source has a frame from, for messages."""
    return source.where(frame) if isinstance(source, LazyFrames) else f"frame {frame}"


class ConstantFrames(LazyFrames[T]):
    """The same array in every frame; used for the masks of a video in which nothing moves.

    Args:
        array: The array; a read-only view of it is handed out.
        length: Number of frames T.
    """

    def __init__(self, array: T, length: int) -> None:
        self._array = array.view()
        self._array.setflags(write=False)
        self._length = length

    def __len__(self) -> int:
        return self._length

    def where(self, frame: int) -> str:
        """Return the frame number; there is no file."""
        return f"constant frame {frame}"

    def _read(self, frame: int) -> T:
        return self._array


def no_masks(size: tuple[int, int], length: int) -> ConstantFrames[Int32Array]:
    """Return ``length`` label maps of ``size`` (height, width) that call everything static."""
    return ConstantFrames(np.zeros(size, dtype=np.int32), length)


def _wrong_size(path: Path, found: tuple[int, int], expected: tuple[int, int], is_cue: bool = True) -> SequenceProblem:
    turned = is_cue and found == expected[::-1]
    return SequenceProblem(
        path,
        f"is {found[1]} x {found[0]} px, but the first image is {expected[1]} x {expected[0]} px",
        "images are turned upright as their files say: make cues from upright images, or remove the orientation flag"
        if turned
        else "bring all frames and cues to one size (and the intrinsics with them)",
    )
