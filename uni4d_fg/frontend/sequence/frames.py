"""Lazy per-frame sources: a file is opened when its frame is asked for, and little is kept."""

from __future__ import annotations

import operator
import threading
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


KEPT_BYTES = 64 * 2**20
"""Decoded frames that a source of files keeps: a run goes through a video some ten times."""


class FileFrames(LazyFrames[T]):
    """One file per frame; every frame must have the size of the video's first image.

    Frames are decoded once as long as they take no more than :data:`KEPT_BYTES`; what is handed out is read-only.

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
        self._kept: dict[int, tuple[tuple[int, int], T]] = {}
        self._kept_bytes = 0
        self._keeping = threading.Lock()
        self.size: tuple[int, int]
        if size is None:
            shape = self._decode(paths[0]).shape
            size = (shape[0], shape[1])
        self.size = size

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs: no frames."""
        return {
            name: value for name, value in self.__dict__.items() if name not in ("_kept", "_kept_bytes", "_keeping")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start with no frames kept."""
        self.__dict__.update(state)
        self._kept, self._kept_bytes, self._keeping = {}, 0, threading.Lock()

    @abstractmethod
    def _decode(self, path: Path) -> T:
        """Return the content of one file."""

    def __len__(self) -> int:
        return len(self.paths)

    def where(self, frame: int) -> str:
        """Return the file of frame ``frame``."""
        return str(self.paths[frame])

    def _read(self, frame: int) -> T:
        version = _version(self.paths[frame])
        with self._keeping:
            kept = self._kept.get(frame)
        if kept is not None and kept[0] == version:
            return kept[1]
        array = self._decoded(frame)
        array.setflags(write=False)
        if version is not None:
            self._keep(frame, version, array)
        return array

    def _keep(self, frame: int, version: tuple[int, int], array: T) -> None:
        """Keep a frame; where there is no room, in place of the one that came last.

        A video is read from its start to its end again and again: whoever came first is asked for first.
        """
        with self._keeping:
            gone = self._kept.pop(frame, None)
            self._kept_bytes -= 0 if gone is None else gone[1].nbytes
            while self._kept and self._kept_bytes + array.nbytes > KEPT_BYTES:
                self._kept_bytes -= self._kept.popitem()[1][1].nbytes
            if array.nbytes <= KEPT_BYTES:
                self._kept[frame] = version, array
                self._kept_bytes += array.nbytes

    def _decoded(self, frame: int) -> T:
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


class FramesInTurn(LazyFrames[T]):
    """The frames of another source, read by one thread at a time: a source of somebody else may not allow more.

    Args:
        source: T frames.
    """

    def __init__(self, source: FrameSource[T]) -> None:
        self.source = source
        self._turn = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what another process needs: no lock."""
        return FramesInTurn, (self.source,)

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> T:
        with self._turn:
            return self.source[frame]


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


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes with a file's content: its time, ns, and size; None if there is no such file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _wrong_size(path: Path, found: tuple[int, int], expected: tuple[int, int], is_cue: bool = True) -> SequenceProblem:
    turned = is_cue and found == expected[::-1]
    return SequenceProblem(
        path,
        f"is {found[1]} x {found[0]} px, but the first image is {expected[1]} x {expected[0]} px",
        "images are turned upright as their files say: make cues from upright images, or remove the orientation flag"
        if turned
        else "bring all frames and cues to one size (and the intrinsics with them)",
    )
