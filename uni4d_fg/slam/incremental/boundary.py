"""What comes into and goes out of an incremental solve: checked once on the way in, copied on the way out.

After an exception within a frame, and after the end, the window is not what its owner thinks; nothing more is taken.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.config.cues import InputConfig
from uni4d_fg.errors import DegenerateProblemError, InputError, SolverError
from uni4d_fg.frontend.sequence.calibration import check_intrinsics
from uni4d_fg.frontend.sequence.frame_checks import (
    checked_depth,
    checked_image,
    checked_mask,
    outside_limits,
    usable_depth,
)
from uni4d_fg.slam.incremental.model import FrameTracks

ValueT = TypeVar("ValueT")


class CheckedFrame(NamedTuple):
    """A frame that belongs to the solver alone."""

    image: ImageArray
    """(H, W, 3) or (H, W) uint8."""
    depth: Float32Array
    """(H, W) meters, NaN where missing."""
    mask: Int32Array
    """(H, W)."""
    tracks: FrameTracks | None
    timestamp: float


class Boundary:
    """The door of an incremental solve.

    Args:
        image_size: (height, width), px.
        limits: Of depth.
    """

    def __init__(self, image_size: tuple[int, int], limits: InputConfig) -> None:
        self.image_size = image_size
        self._limits = limits
        self._without_depth = 0
        """As long as no frame had usable depth, how many there were; -1 from then on."""
        self._closed: str | None = None
        self._tracks_given: bool | None = None

    def check(
        self, number: int, image: Any, depth: Any, mask: Any, tracks: FrameTracks | None, timestamp: float | None
    ) -> CheckedFrame:
        """Check the next frame and return a copy of it.

        Raises:
            InputError: If an array has another shape or type than it must, the timestamp is not finite, tracks are
                given for some frames only, or there is depth for the first time, and all of it is outside the limits.
            SolverError: If no frame can be taken any more.
        """
        if self._closed is not None:
            raise SolverError(self._closed)
        where = f"frame {number}"
        time = self._time(where, number if timestamp is None else timestamp)
        frame = CheckedFrame(
            checked_image(image, self.image_size, f"{where}: image", gray=True).copy(),
            checked_depth(depth, self.image_size, f"{where}: depth"),
            np.zeros(self.image_size, np.int32)
            if mask is None
            else checked_mask(mask, self.image_size, f"{where}: mask").copy(),
            self._checked_tracks(where, number, tracks),
            time,
        )
        if number <= self._without_depth:  # all others lacked it; a solve that was resumed may have seen some
            self._without_depth = number + 1 if self._lacks_depth(f"{where}: depth", depth, frame.depth) else -1
        self._tracks_given = tracks is not None
        return frame

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Within the block the solve changes: an exception leaves it in no state to go on from."""
        try:
            yield
        except BaseException as error:
            self._closed = (
                f"an earlier frame ended with {type(error).__name__} ({error}): the window is not to be relied on; "
                "start again, or from a checkpoint"
            )
            raise

    def check_finish(self, num_frames: int) -> None:
        """Raise DegenerateProblemError if there were frames, and none had usable depth."""
        if 0 < num_frames <= self._without_depth:
            raise DegenerateProblemError(
                f"none of the {num_frames} frames has depth, and without any there is no scene; give meters, and NaN "
                "only where depth is missing"
            )

    def close(self) -> None:
        """Take no more frames: the window was handed over."""
        self._closed = self._closed or "the stream was finished: no more frames can be added; start a new one"

    @staticmethod
    def _time(where: str, timestamp: Any) -> float:
        try:
            time = float(timestamp)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{where}: the timestamp {timestamp!r} is no number; give seconds") from error
        if not np.isfinite(time):
            raise InputError(f"{where}: the timestamp {timestamp} is not finite; give seconds")
        return time

    def _lacks_depth(self, where: str, given: Any, depth: Float32Array) -> bool:
        """Tell whether a depth map is missing everywhere. Raises InputError if it is not, and none of it is usable."""
        if usable_depth(depth, self._limits).any():
            return False
        known = depth[np.isfinite(depth)]
        if known.size:
            what, remedy = outside_limits(float(np.median(known)), self._limits, "m", "in every pixel")
            raise InputError(f"{where} {what}; {remedy}")
        given = np.asarray(given)
        negative = given[np.isfinite(given) & (given < 0)]
        if negative.size and negative.min() < negative.max():  # one number everywhere stands for "missing"
            raise InputError(
                f"{where} is negative wherever it is finite; give meters along the view, which are positive"
            )
        return True

    def _checked_tracks(self, where: str, number: int, tracks: FrameTracks | None) -> FrameTracks | None:
        if number and self._tracks_given is not None and self._tracks_given is not (tracks is not None):
            raise InputError(
                f"{where}: tracks are given for some frames and not for others, whose numbers would mean other points; "
                "give them for all or for none"
            )
        if tracks is None:
            return None
        if not isinstance(tracks, FrameTracks):
            raise InputError(f"{where}: tracks are a {type(tracks).__name__}; give FrameTracks(track, uv)")
        if tracks.track.dtype.kind not in "iu" or (len(tracks.track) and int(tracks.track.max()) >= 2**62):
            raise InputError(f"{where}: track numbers must be whole and below 2**62, got {tracks.track.dtype}")
        height, width = self.image_size
        inside = (tracks.uv > -width) & (tracks.uv < 2 * width)
        inside[:, 1:] = (tracks.uv[:, 1:] > -height) & (tracks.uv[:, 1:] < 2 * height)
        if not inside.all():
            raise InputError(f"{where}: a track lies far outside the image; give pixels of the image as (x, y)")
        return FrameTracks(tracks.track.astype(np.int64), tracks.uv.astype(np.float64))


def checked_size(image_size: Any) -> tuple[int, int]:
    """Return an image size (height, width) in px. Raises InputError if it is not two positive whole numbers."""
    try:
        height, width = (operator.index(n) for n in image_size)
    except (TypeError, ValueError) as error:
        raise InputError(f"image_size {image_size!r} is not (height, width) in whole px") from error
    if height < 1 or width < 1:
        raise InputError(f"image_size {image_size!r} must be positive px")
    return height, width


def checked_intrinsics(intrinsics: Any, image_size: tuple[int, int]) -> FloatArray:
    """Return a copy of intrinsics (4,) fx, fy, cx, cy, px, of images of ``image_size`` (height, width).

    Raises:
        InputError: If they are not finite, or those of no camera with such images.
    """
    array = np.array(intrinsics, dtype=np.float64)
    if array.shape != (4,) or not np.isfinite(array).all() or (array[:2] <= 0).any():
        raise InputError(f"intrinsics must be fx, fy, cx, cy in px with positive focal lengths, got {array}")
    check_intrinsics(array, image_size, "intrinsics")
    return array


def detached(value: ValueT) -> ValueT:
    """Return a result whose arrays are copies: whoever writes into them changes nothing of the solve."""
    copied: Any = value
    if isinstance(value, np.ndarray):
        copied = value.copy()
    elif isinstance(value, tuple):
        copied = tuple(detached(item) for item in value)
    elif is_dataclass(value) and not isinstance(value, type):
        copied = replace(value, **{field.name: detached(getattr(value, field.name)) for field in fields(value)})
    result: ValueT = copied
    return result
