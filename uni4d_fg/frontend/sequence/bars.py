"""Black bars: the part of the images that shows something, found from the frames.

A bar is a strip along a side that is black in every frame, behind a straight edge: right beside it most of the side is
brighter in some frame. A dark scene has no such edge, as what is dark in it has a shape.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import TypeVar

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, Int32Array, evenly_spread
from uni4d_fg.frontend.sequence.frames import LazyFrames, where_of
from uni4d_fg.frontend.sequence.model import Content, FrameSource, Sequence, Video
from uni4d_fg.frontend.track_model import Tracks

_SAMPLES = 12
"""Frames that are looked at."""
_BLACK = 20
"""Gray value that coding leaves in black at most: video black of 16 that was not expanded, and noise."""
_SPECKS = 0.005
"""Part of a bar's line that may be brighter."""
_SHOWN = 0.6
"""Part of the first line beside a bar that is brighter than it in some frame."""
_STEP = 24
"""By how many gray values: light that falls off to black has no such step."""
_BLEND = 3
"""Lines between the two, where scaling has blended them, at most."""
_LEAST_PX = 2
_LEAST_CONTENT = 0.4
"""Part of each side that is left, at least."""

_VideoT = TypeVar("_VideoT", Video, Sequence)
_MapT = TypeVar("_MapT", Float32Array, Int32Array, BoolArray)


def _brightest_channel(image: ImageArray) -> ImageArray:
    """Return the maximum (H, W) over the channels of (H, W, C); NumPy is slow along short axes."""
    return reduce(np.maximum, (image[..., channel] for channel in range(image.shape[2])))


def find_content(images: FrameSource[ImageArray]) -> Content:
    """Return the part of the images (T of (H, W, 3) or (H, W), uint8) between black bars; all where there are none.

    Raises:
        InputError: If a frame cannot be read.
    """
    brightest: ImageArray | None = None
    for frame in evenly_spread(len(images), min(_SAMPLES, len(images))).tolist():
        image = images[frame]
        gray = image if image.ndim == 2 else _brightest_channel(image)
        brightest = gray if brightest is None else np.maximum(brightest, gray)
    if brightest is None:
        return Content(0, 0, 0, 0)
    height, width = brightest.shape
    # Rows first: within them, columns are judged without the bars above and below.
    top, bottom = _bar(brightest), _bar(brightest[::-1])
    inner = brightest[top : height - bottom].T
    left, right = _bar(inner), _bar(inner[::-1])
    if top or bottom:
        return Content(top, height - bottom, left, width - right)
    # With bars at the sides, those above and below are seen only between them.
    inner = brightest[:, left : width - right]
    return Content(_bar(inner), height - _bar(inner[::-1]), left, width - right)


def _bar(brightest: ImageArray) -> int:
    """Return how many of the first lines (N, M) are a bar."""
    if min(brightest.shape) == 0:
        return 0
    black = (brightest > _BLACK).mean(axis=1) <= _SPECKS
    count = len(black) if black.all() else int(np.argmin(black))
    if count < _LEAST_PX or count > (1.0 - _LEAST_CONTENT) * len(brightest):
        return 0
    level = float(np.quantile(brightest[:count], 1.0 - _SPECKS))
    for line in range(count, min(count + _BLEND + 1, len(brightest))):
        if (brightest[line] > level + _STEP).mean() >= _SHOWN:
            return line
    return 0


def only_content(values: _MapT, content: Content, outside: float) -> _MapT:
    """Return a map (H, W) with another value in the bars."""
    kept = np.full_like(values, outside)
    kept[content.slices] = values[content.slices]
    return kept


class InsideFrames(LazyFrames[Float32Array]):
    """Maps of which only the content is kept; NaN elsewhere."""

    def __init__(self, source: FrameSource[Float32Array], content: Content) -> None:
        self.source, self.content = source, content

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> Float32Array:
        return only_content(self.source[frame], self.content, np.nan)


class StaticOutside(LazyFrames[Int32Array]):
    """Label maps that call everything outside the content static."""

    def __init__(self, source: FrameSource[Int32Array], content: Content) -> None:
        self.source, self.content = source, content

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> Int32Array:
        return only_content(self.source[frame], self.content, 0)


class CroppedFrames(LazyFrames[ImageArray]):
    """The content of images."""

    def __init__(self, source: FrameSource[ImageArray], content: Content) -> None:
        self.source, self.content = source, content

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> ImageArray:
        return np.ascontiguousarray(self.source[frame][self.content.slices])


def without_bars(video: _VideoT, *, look: bool = True) -> _VideoT:
    """Return a video whose depth, masks and tracks say nothing of black bars; images keep their size.

    Args:
        video: A video or sequence; one whose content is known is returned as it is.
        look: Whether bars are looked for; without, everything is content.

    Raises:
        InputError: If a frame cannot be read.
    """
    if video.content is not None:
        return video
    whole = Content(0, video.image_size[0], 0, video.image_size[1])
    content = find_content(video.images) if look else whole
    if content == whole:
        return replace(video, content=whole)
    return replace(
        video,
        content=content,
        depths=None if video.depths is None else InsideFrames(video.depths, content),
        masks=None if video.masks is None else StaticOutside(video.masks, content),
        tracks=None if video.tracks is None else tracks_inside(video.tracks, content),
    )


def tracks_inside(tracks: Tracks, content: Content) -> Tracks:
    """Mark observations outside the content as not visible."""
    first, last = (content.left, content.top), (content.right - 1, content.bottom - 1)
    with np.errstate(invalid="ignore"):
        inside = np.asarray((tracks.uv >= first).all(axis=-1) & (tracks.uv <= last).all(axis=-1))
    uv = np.where(inside[..., None], tracks.uv, np.float32(np.nan))
    return replace(tracks, uv=uv, visible=tracks.visible & inside)


def bars_note(content: Content | None, size: tuple[int, int]) -> list[str]:
    """Return what a summary says of the bars of images of ``size`` (height, width); nothing without any."""
    if content is None or content == Content(0, size[0], 0, size[1]):
        return []
    sides = zip(
        ("above", "below", "left", "right"),
        (content.top, size[0] - content.bottom, content.left, size[1] - content.right),
        strict=True,
    )
    listed = ", ".join(f"{width} px {side}" for side, width in sides if width)
    return [f"black bars are left out: {listed}"]
