"""A video made smaller, with everything that is measured in its pixels.

Pixel centers are at integers, so that the image reaches from -0.5 to W - 0.5. A pixel ``u`` of the full image
lies at ``(u + 0.5) s - 0.5`` of the small one, where ``s`` is the ratio of the widths (of the heights for v).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.frontend.sequence.frames import ChangedFrames, T
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks


def fitting_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """Return the (height, width) whose longer side is ``max_size`` px, or ``size`` if that is no larger."""
    scale = max_size / max(size)
    if scale >= 1:
        return size
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def scale_intrinsics(intrinsics: FloatArray, size: tuple[int, int], new_size: tuple[int, int]) -> FloatArray:
    """Return the intrinsics of an image after its size changed.

    Args:
        intrinsics: (4,) fx, fy, cx, cy, px, of images of ``size``.
        size: (height, width), px.
        new_size: (height, width), px.

    Returns:
        (4,) new array, px.
    """
    scale = np.array([new_size[1] / size[1], new_size[0] / size[0]])
    return np.concatenate((intrinsics[:2] * scale, (intrinsics[2:] + 0.5) * scale - 0.5))


def resize_image(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """Return an image (H, W, 3) at a smaller ``size`` (height, width): each pixel the mean of what it covers."""
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def resize_nearest(array: T, size: tuple[int, int]) -> T:
    """Return a map (H, W) at another ``size`` (height, width): each pixel the one nearest to its center."""
    rows, columns = (
        np.floor((np.arange(new) + 0.5) * (old / new)).astype(np.int64)
        for old, new in zip(array.shape[:2], size, strict=True)
    )
    return array[np.ix_(rows, columns)]  # type: ignore[return-value]


def _maps(source: FrameSource[T] | None, size: tuple[int, int]) -> FrameSource[T] | None:
    return None if source is None else ChangedFrames(source, partial(resize_nearest, size=size))


def resize_video(video: Video, max_size: int) -> Video:
    """Return a video whose longer side is at most ``max_size`` px; frames are resized as they are read.

    Images are averaged; depth and masks take the nearest pixel; intrinsics and tracks are scaled. The arrays of
    ``video`` are not changed.
    """
    size, new_size = video.image_size, fitting_size(video.image_size, max_size)
    if new_size == size:
        return video
    truth = video.ground_truth
    return replace(
        video,
        images=ChangedFrames(video.images, partial(resize_image, size=new_size)),
        image_size=new_size,
        depths=_maps(video.depths, new_size),
        masks=_maps(video.masks, new_size),
        intrinsics=None if video.intrinsics is None else scale_intrinsics(video.intrinsics, size, new_size),
        tracks=None if video.tracks is None else resize_tracks(video.tracks, size, new_size),
        ground_truth=replace(
            truth,
            depths=_maps(truth.depths, new_size),
            masks=_maps(truth.masks, new_size),
            intrinsics=None if truth.intrinsics is None else scale_intrinsics(truth.intrinsics, size, new_size),
        ),
    )


def resize_tracks(tracks: Tracks, size: tuple[int, int], new_size: tuple[int, int]) -> Tracks:
    """Return tracks of images of ``size`` (height, width) for images of ``new_size``.

    An observation that comes to lie outside the pixel centers by rounding stays visible.
    """
    scale = np.array([new_size[1] / size[1], new_size[0] / size[0]])
    uv = ((tracks.uv + 0.5) * scale - 0.5).astype(np.float32)
    blur_px = None if tracks.blur_px is None else tracks.blur_px * np.float32(np.sqrt(scale.prod()))
    return replace(tracks, uv=uv, blur_px=blur_px)
