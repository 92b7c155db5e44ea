"""Cues on disk, one file per frame, named by the content of the image: what is there is not made again.

A folder belongs to one maker: a card with its weights, and the configuration it depends on. A frame's file is
written whole when the frame is done, so that a run that is stopped or killed loses the frame in work at most.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.packed_maps import load_map, save_map
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_path, atomic_write_text, load_npy, load_npz, save_npy, save_npz
from uni4d_fg.frontend.sequence.digest import add_array
from uni4d_fg.frontend.sequence.frames import FileFrames

CACHE_VERSION = 28
"""Part of every key; raised whenever a maker gives other cues for the same image, card and configuration."""


def image_key(image: ImageArray) -> str:
    """Return a hexadecimal key of the pixels of an image."""
    digest = hashlib.blake2b(digest_size=16)
    add_array(digest, image)
    return digest.hexdigest()


def maker_key(*parts: Any) -> str:
    """Return a hexadecimal key of everything else that a cue depends on; models and plain values."""
    plain = [part.model_dump(mode="json") if hasattr(part, "model_dump") else part for part in parts]
    return hashlib.blake2b(json.dumps([CACHE_VERSION, *plain], sort_keys=True).encode(), digest_size=10).hexdigest()


class FloatMaps(FileFrames[Float32Array]):
    """T files of (H, W) float32, rounded as in ``packed_maps``: disparity may be zero or negative, unlike depth."""

    def _decode(self, path: Path) -> Float32Array:
        # Earlier versions wrote plain arrays.
        values: Float32Array = load_npy(path) if path.suffix == ".npy" else load_map(path)
        if values.ndim != 2 or values.dtype != np.float32:
            raise InputError(f"{path}: is not a map of the cue cache; remove it and start again")
        return values


class FrameCache:
    """The folder of one maker.

    Args:
        folder: Where its files are; made when the first is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def map_path(self, key: str) -> Path:
        """Return the file of a map."""
        return self.folder / f"{key}.map.npz"

    def has_map(self, key: str, size: tuple[int, int]) -> bool:
        """Tell whether an undamaged map of (height, width) is there: it is read, which compares its checksum."""
        path = self.map_path(key)
        if not path.is_file():
            return False
        try:
            return load_map(path).shape == size
        except InputError:
            return False

    def put_map(self, key: str, values: Float32Array) -> Path:
        """Write a map, rounded as :func:`~uni4d_fg.cues.packed_maps.save_map` says. Raises OutputError."""
        path = self.map_path(key)
        save_map(path, values)
        return path

    def camera(self, key: str) -> FloatArray | None:
        """Return the (4,) intrinsics kept with a map, or None."""
        try:
            found = load_npy(self.folder / f"{key}.camera.npy")
        except InputError:
            return None
        return found.astype(np.float64) if found.shape == (4,) else None

    def put_camera(self, key: str, intrinsics: FloatArray) -> None:
        """Keep (4,) intrinsics with a map; to be called before :meth:`put_map`. Raises OutputError."""
        save_npy(self.folder / f"{key}.camera.npy", intrinsics, checksum=True)

    def detections(self, key: str, size: tuple[int, int]) -> FrameDetections | None:
        """Return the detections of a frame of (height, width) if they are there and readable."""
        path = self.folder / f"{key}.npz"
        if not path.is_file():
            return None
        try:
            stored = load_npz(path, {"bits": 2, "class_ids": 1, "scores": 1})
            count = len(stored["class_ids"])
            masks = np.unpackbits(stored["bits"].astype(np.uint8), axis=1, count=size[0] * size[1])
            return FrameDetections(
                masks.reshape(count, *size).astype(bool),
                stored["class_ids"].astype(np.int32),
                stored["scores"].astype(np.float32),
            )
        except (InputError, ValueError):
            return None

    def put_detections(self, key: str, found: FrameDetections) -> None:
        """Write the detections of a frame. Raises OutputError."""
        bits = np.packbits(found.masks.reshape(len(found), found.masks.shape[1] * found.masks.shape[2]), axis=1)
        save_npz(self.folder / f"{key}.npz", bits=bits, class_ids=found.class_ids, scores=found.scores)

    def arrays(self, name: str, ranks: dict[str, int | None]) -> dict[str, npt.NDArray[Any]] | None:
        """Return named arrays that were kept under a name, or None."""
        path = self.folder / f"{name}.npz"
        if not path.is_file():
            return None
        try:
            return load_npz(path, ranks)
        except InputError:
            return None

    def put_arrays(self, name: str, **arrays: npt.ArrayLike) -> None:
        """Keep named arrays under a name. Raises OutputError."""
        save_npz(self.folder / f"{name}.npz", **arrays)

    def mark_complete(self) -> None:
        """Say that all frames are there. Raises OutputError."""
        atomic_write_text(self.folder / "complete", "")

    def is_complete(self) -> bool:
        """Tell whether :meth:`mark_complete` was called."""
        return (self.folder / "complete").is_file()

    def clear(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)


def write_labels(path: Path, labels: Int32Array) -> None:
    """Write (H, W) instance ids as PNG: one channel up to 255, red + 256 green + 65536 blue beyond.

    Raises:
        OutputError: If an id is negative or too large, or the file cannot be written.
    """
    low, high = int(labels.min()), int(labels.max())
    if low < 0 or high >= 256**3:
        raise OutputError(f"cannot write {path}: mask ids reach from {low} to {high}; use ids from 0 to {256**3 - 1}")
    if high <= 255:
        pixels = labels.astype(np.uint8)
    else:
        pixels = np.stack([(labels >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
    encoded, data = cv2.imencode(".png", pixels)
    if not encoded:
        raise OutputError(f"cannot write {path}: encoding a {labels.shape} mask failed; check its size")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


class Rate:
    """Turns frames done into "2.5 frames/s, 0:40 left".

    Args:
        total: Frames to do.
        clock: Seconds, only ever growing.
    """

    def __init__(self, total: int, clock: Callable[[], float]) -> None:
        self.total = total
        self._clock = clock
        self._began = clock()
        self._made = 0

    def text(self, done: int, made: bool) -> str:
        """Return the rate of the frames made so far and the time that is left; ``made``: not found in the cache."""
        self._made += made
        elapsed = self._clock() - self._began
        if self._made == 0 or elapsed <= 0:
            return f"{done} of {self.total}"
        per_second = self._made / elapsed
        left = round((self.total - done) / per_second)
        return f"{per_second:.2g} frames/s, {left // 60}:{left % 60:02d} left"
