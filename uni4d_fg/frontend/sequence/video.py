"""Frames of a video file, decoded forwards, with a cache of a few frames."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.frontend.sequence.containers import is_container, missing_bytes
from uni4d_fg.frontend.sequence.display import Display, display_of
from uni4d_fg.frontend.sequence.frames import LazyFrames
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.reading import check_regular

_CACHED_FRAMES = 4
_CACHED_BYTES = 2**27  # when read backwards
_STEP_BACK = 16  # frames; a longer step back is a jump
_SEEK_MARGIN = 16  # frames
_SAME_TIME = 1e-5  # seconds
_PAST_DAMAGE = 32
"""Attempts to go on where a frame cannot be decoded: at the end of a file none succeeds."""
_REMEDY = "re-encode the video, or extract its frames into rgb/"


class VideoFrames(LazyFrames[ImageArray]):
    """A video file as T images (H, W, 3) uint8 RGB, as players show it: upright, unmirrored, with square pixels.

    Seeking in compressed video is not frame-exact, so frames are reached by decoding forwards: reading in
    order costs one decode per frame. Reading in reverse order decodes a block of frames at a time. On construction
    the frames are decoded once, without keeping them, because what a file announces of their number and times
    is often wrong.

    Args:
        path: The video file.
        stop: Frames from this one on are not looked at; None for all.

    Attributes:
        path: The video file.
        display: How stored pictures are shown.
        size: (height, width) as shown, px.
        frame_rate: Frames per second; None when the file does not say.
        times: (T,) seconds at which the frames are shown, strictly increasing (variable frame rates included); None
            when the file has no such times.

    Raises:
        InputError: If the file cannot be opened, is cut short, is damaged before its end or holds no frame, and on
            indexing if a frame cannot be decoded.
    """

    def __init__(self, path: Path, stop: int | None = None) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, ImageArray] = OrderedDict()
        self._capture: Any = cv2.VideoCapture()
        self.display = Display()
        self._next = 0
        self._last = -1
        self._open()
        samples = [float(self._capture.get(p)) for p in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN)]
        rotation = float(self._capture.get(cv2.CAP_PROP_ORIENTATION_META))
        self.display = display_of(path, samples[0] / samples[1] if samples[1] > 0 else 0.0, rotation)
        self._orient()
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frame_rate = rate if np.isfinite(rate) and rate > 0 else None
        first = self._advance_to(0)
        if first is None:
            self._check_complete(0)
            raise SequenceProblem(path, "holds no frame that can be decoded", _REMEDY)
        self.size: tuple[int, int] = (first.shape[0], first.shape[1])
        self._block = max(_CACHED_FRAMES, _CACHED_BYTES // first.nbytes)
        self._length, self.times = self._look_through(stop)

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs to open the file itself; what was found in it is not looked for again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_lock", "_cache", "_capture")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Open the file. Raises InputError if it is gone."""
        self.__dict__.update(state)
        self._lock, self._cache, self._capture, self._last = threading.Lock(), OrderedDict(), cv2.VideoCapture(), -1
        self._open()

    def _open(self) -> None:
        if check_regular(self.path, "a video file") == 0:
            raise SequenceProblem(self.path, "is empty", "copy it again")
        if not is_container(self.path):
            raise SequenceProblem(self.path, "cannot be opened as a video", _REMEDY)
        self._capture.release()
        self._capture = _quiet_capture(self.path)
        self._next = 0
        if not self._capture.isOpened():
            self._check_complete(0)
            raise SequenceProblem(self.path, "cannot be opened as a video", _REMEDY)
        self._orient()

    def _orient(self) -> None:
        """Leave to the decoder to turn pictures, unless they are mirrored, which it cannot."""
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1.0 if self.display.mirror is None else 0.0)

    def _check_complete(self, readable: int) -> None:
        """Raise InputError if the end of the file is missing; ``readable`` frames come before."""
        missing = missing_bytes(self.path)
        if missing:
            use = f", or select frames before {readable - 1}" if readable > 2 else ""
            raise SequenceProblem(
                self.path, f"is cut short: {missing} bytes are missing at its end", f"copy it again{use}"
            )

    def _look_through(self, stop: int | None) -> tuple[int, FloatArray | None]:
        """Return the number of frames and the times (T,) at which they are shown, in seconds."""
        self._open()
        times: list[float] = []
        while (stop is None or len(times) < stop) and self._capture.grab():
            times.append(1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC)))
        if stop is None or len(times) < stop:
            self._check_complete(len(times))
            if any(self._capture.grab() for _ in range(_PAST_DAMAGE)):
                before = f", or select frames before {len(times)}" if len(times) > 1 else ""
                raise SequenceProblem(
                    self.where(len(times)), "cannot be decoded, though others follow", f"{_REMEDY}{before}"
                )
        self._open()
        found = np.array(times)
        return len(found), found if np.isfinite(found).all() and (np.diff(found) > 0).all() else None

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
        return self.display.apply(pixels[:, :, ::-1])

    def __len__(self) -> int:
        return self._length

    def where(self, frame: int) -> str:
        """Return the file and frame number."""
        return f"{self.path} [frame {frame}]"

    def _read(self, frame: int) -> ImageArray:
        with self._lock:
            steps_back = 0 < self._last - frame <= _STEP_BACK
            self._last = frame
            if frame in self._cache:
                return self._cache[frame].copy()
            # Whoever steps back will do so again: the frames before are kept while they are at hand.
            first = max(frame + 1 - self._block, 0) if steps_back else frame
            self._rewind(first)
            while len(self._cache) > (0 if steps_back else _CACHED_FRAMES - 1):
                self._cache.popitem(last=False)
            for wanted in range(first, frame + 1):
                image = self._advance_to(wanted)
                if image is None:
                    self._open()
                    raise SequenceProblem(self.where(wanted), "cannot be decoded", _REMEDY)
                if image.shape[:2] != self.size:
                    raise SequenceProblem(self.where(wanted), "has another size than the first frame", _REMEDY)
                self._cache[wanted] = image
            return self._cache[frame].copy()

    def _rewind(self, frame: int) -> None:
        """Make sure that the next decoded frame is not behind ``frame``."""
        if frame >= self._next:
            return
        self._open()
        if self.times is None or frame <= _SEEK_MARGIN:
            return
        # A seek may end anywhere, and what follows it at once may be damaged. The time of the frame that it ends at
        # tells which one it is; if that is none, or too late, frames are decoded from the first.
        self._capture.set(cv2.CAP_PROP_POS_MSEC, 1e3 * float(self.times[frame - _SEEK_MARGIN]))
        if self._capture.grab():
            time = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
            reached = int(np.abs(self.times - time).argmin())
            if abs(self.times[reached] - time) < _SAME_TIME and reached <= frame - _SEEK_MARGIN:
                self._next = reached + 1
                return
        self._open()


def _quiet_capture(path: Path) -> Any:
    """Open a video without messages of the decoder on stderr; whoever wants them sets the variable."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(min(level, log.LOG_LEVEL_ERROR))
    try:
        return cv2.VideoCapture(str(path), _backend())
    finally:
        log.setLogLevel(level)


def _backend() -> int:
    """Return OpenCV's FFmpeg reader if this build has it; the others take image files for videos, or guess times."""
    has_ffmpeg = cv2.CAP_FFMPEG in cv2.videoio_registry.getStreamBackends()
    return int(cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY)
