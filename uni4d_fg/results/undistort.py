"""A run as a pinhole would have seen it: frames, depth, masks and tracks without the lens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.frames import ChangedFrames
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.results.run import Run

_BORDER_SAMPLES = 256
_FOCAL_RANGE = (0.1, 4.0)
"""Focal lengths that are tried, in those of the camera."""


@dataclass(frozen=True)
class Undistortion:
    """From the pixels of a camera with a lens to those of a pinhole of the same size."""

    camera: FloatArray
    """(4,) intrinsics of the images as they are."""
    lens: Lens
    pinhole: FloatArray
    """(4,) those of the undistorted images."""
    maps: tuple[Float32Array, Float32Array]
    """(H, W) u and v of the real pixel that each undistorted pixel shows."""

    @classmethod
    def of(cls, camera: FloatArray, lens: Lens, size: tuple[int, int]) -> Undistortion:
        """Choose the widest pinhole of ``size`` (height, width) whose every pixel the camera saw."""
        low, high = _FOCAL_RANGE
        if not _is_filled(camera, lens, size, high):
            raise InputError(
                "no pinhole image of this size shows only what the camera saw; export without undistorting"
            )
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if _is_filled(camera, lens, size, middle) else (middle, high)
        pinhole = camera * np.array([high, high, 1.0, 1.0])
        height, width = size
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        real = _real(camera, lens, high, np.stack([u, v], axis=-1)).astype(np.float32)
        return cls(camera, lens, pinhole, (real[..., 0], real[..., 1]))

    def pixels(self, real: FloatArray) -> FloatArray:
        """Return where the pinhole shows what the camera showed at pixels (..., 2); NaN where it cannot."""
        plane = (self.lens.ideal_pixels(self.camera, real) - self.camera[2:]) / self.camera[:2]
        return np.asarray(plane * self.pinhole[:2] + self.pinhole[2:])

    def frame(self, array: npt.NDArray[Any], interpolation: int) -> npt.NDArray[Any]:
        """Return one image or map (H, W, ...) as the pinhole sees it."""
        return np.asarray(cv2.remap(array, *self.maps, interpolation, borderMode=cv2.BORDER_REPLICATE))

    def tracks(self, labelled: LabelledTracks, size: tuple[int, int]) -> LabelledTracks:
        """Move tracks; observations that leave the image count as not visible."""
        height, width = size
        tracks = labelled.tracks
        uv = self.pixels(tracks.uv.astype(np.float64))
        with np.errstate(invalid="ignore"):
            inside = (uv >= -0.5).all(axis=2) & (uv[..., 0] < width - 0.5) & (uv[..., 1] < height - 0.5)
        visible = tracks.visible & inside
        uv[~visible] = np.nan
        weight = np.where(visible, labelled.weight, np.float32(0.0))
        moved = replace(tracks, uv=uv.astype(np.float32), visible=visible)
        return replace(labelled, tracks=moved, weight=weight)


def undistorted(run: Run) -> Run:
    """Return a run without its lens; the run itself if it has none.

    Images are interpolated; depth, which is z-depth and does not change its value, and masks take the nearest pixel.

    Raises:
        InputError: If the sequence of the run is not at hand, or no pinhole image is filled.
    """
    result = run.reconstruction
    if result.lens.is_pinhole:
        return run
    how = Undistortion.of(result.intrinsics, result.lens, result.image_size)

    def smooth(source: FrameSource[Any]) -> FrameSource[Any]:
        return ChangedFrames(source, lambda image: how.frame(np.asarray(image), cv2.INTER_LINEAR))

    def nearest(source: FrameSource[Any]) -> FrameSource[Any]:
        return ChangedFrames(source, lambda values: how.frame(np.asarray(values), cv2.INTER_NEAREST))

    parts: dict[str, Any] = {"reconstruction": replace(result, intrinsics=how.pinhole, lens=PINHOLE)}
    sequence = run.sequence
    if isinstance(sequence, Sequence):
        parts["sequence"] = replace(
            sequence, images=smooth(sequence.images), depths=nearest(sequence.depths), masks=nearest(sequence.masks),
            intrinsics=how.pinhole, lens=PINHOLE, tracks=None,
        )  # fmt: skip
    if run.depth is not None:
        parts["depth"] = nearest(run.depth)
    if run.confidence is not None:
        parts["confidence"] = nearest(run.confidence)
    if run.labelled is not None:
        parts["labelled"] = how.tracks(run.labelled, result.image_size)
    return run.with_parts(**parts)


def _real(camera: FloatArray, lens: Lens, focal: float, pixels: FloatArray) -> FloatArray:
    """Return the real pixels of pixels of a pinhole whose focal length is ``focal`` times the camera's."""
    return lens.real_pixels(camera, (pixels - camera[2:]) / focal + camera[2:])


def _is_filled(camera: FloatArray, lens: Lens, size: tuple[int, int], focal: float) -> bool:
    """Return whether the camera saw the whole border of a pinhole image."""
    height, width = size
    u, v = np.linspace(0, width - 1, _BORDER_SAMPLES), np.linspace(0, height - 1, _BORDER_SAMPLES)
    border = np.concatenate(
        [np.stack([u, np.full_like(u, y)], axis=1) for y in (0, height - 1)]
        + [np.stack([np.full_like(v, x), v], axis=1) for x in (0, width - 1)]
    )
    real = _real(camera, lens, focal, border)
    inside = (real >= 0.0).all() and (real <= np.array([width - 1, height - 1])).all()
    # Where the lens folds, a direction far outside of the image comes to lie in it.
    back = lens.ideal_pixels(camera, real)
    same = np.abs(back - ((border - camera[2:]) / focal + camera[2:])).max(initial=0.0) < 1.0
    return bool(inside and same)
