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

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array
from uni4d_fg.errors import InputError, SolverError
from uni4d_fg.frontend.sequence.frame_checks import checked_depth, checked_image, checked_mask
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
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self.image_size = image_size
        self._closed: str | None = None
        self._tracks_given: bool | None = None

    def check(
        self, number: int, image: Any, depth: Any, mask: Any, tracks: FrameTracks | None, timestamp: float | None
    ) -> CheckedFrame:
        """Check the next frame and return a copy of it.

        Raises:
            InputError: If an array has another shape or type than it must, the timestamp is not finite, or tracks are
                given for some frames only.
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
