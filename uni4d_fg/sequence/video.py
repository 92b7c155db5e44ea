"""Frames of a video file, decoded forwards, with a cache of a few frames."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray
from uni4d_fg.sequence.frames import LazyFrames
from uni4d_fg.sequence.problems import SequenceProblem

_CACHED_FRAMES = 4
_REMEDY = "re-encode the video, or extract its frames into rgb/"


class VideoFrames(LazyFrames[ImageArray]):
    """A video file as T images (H, W, 3) uint8 RGB.

    Seeking in compressed video is not frame-exact, so frames are reached by decoding forwards: reading in
    order costs one decode per frame; going back by more than a few frames starts again from the first.

    Args:
        path: The video file.

    Attributes:
        path: The video file.
        size: (height, width), px.
        frame_rate: Frames per second; None when the file does not say.

    Raises:
        InputError: If the file cannot be opened or holds no frame, and on indexing if a frame cannot be
            decoded.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, ImageArray] = OrderedDict()
        self._capture: Any = cv2.VideoCapture()
        self._next = 0
        self._open()
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frame_rate = rate if np.isfinite(rate) and rate > 0 else None
        first = self._advance_to(0)
        if first is None:
            raise SequenceProblem(path, "holds no frame that can be decoded", _REMEDY)
        self.size: tuple[int, int] = (first.shape[0], first.shape[1])
        self._length = self._count()

    def _open(self) -> None:
        if not self.path.is_file():
            raise SequenceProblem(self.path, "no such video file", "check the path")
        self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0
        if not self._capture.isOpened():
            raise SequenceProblem(self.path, "cannot be opened as a video", _REMEDY)

    def _count(self) -> int:
        """Count the frames; what the file announces is believed only if its last frame can be decoded."""
        announced = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if announced > 0:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, announced - 1)
            last_exists = self._capture.grab()
            beyond_exists = last_exists and self._capture.grab()
            self._open()
            if last_exists and not beyond_exists:
                return announced
        count = 0
        while self._capture.grab():
            count += 1
        self._open()
        return count

    def _advance_to(self, frame: int) -> ImageArray | None:
        """Decode forwards up to ``frame``; None where the file ends or breaks before."""
        while self._next < frame:
            if not self._capture.grab():
                return None
            self._next += 1
        decoded, pixels = self._capture.read()
        if not decoded:
            return None
        self._next += 1
        return np.ascontiguousarray(pixels[:, :, ::-1])

    def __len__(self) -> int:
        return self._length

    def where(self, frame: int) -> str:
        """Return the file and frame number."""
        return f"{self.path} [frame {frame}]"

    def _read(self, frame: int) -> ImageArray:
        with self._lock:
            if frame in self._cache:
                return self._cache[frame].copy()
            if frame < self._next:
                self._open()
            image = self._advance_to(frame)
            if image is None:
                self._open()
                raise SequenceProblem(self.where(frame), "cannot be decoded", _REMEDY)
            self._cache[frame] = image
            while len(self._cache) > _CACHED_FRAMES:
                self._cache.popitem(last=False)
            return image.copy()
