"""Frames at the size at which views are matched: gray, with and without what moves, and the camera of that size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.results.fusion.matching_size import times_finer

ONE_SURFACE = 0.04
"""Log depths that differ by less are averaged."""
MapT = TypeVar("MapT", BoolArray, Float32Array, ImageArray)


@dataclass(frozen=True)
class WorkingSize:
    """A size (height, width), px, smaller than the images', and the way there."""

    height: int
    width: int
    image_size: tuple[int, int]
    """(H, W), px."""

    @property
    def plain(self) -> WorkingSize:
        """The same without a lens: that of the shrunk images, whatever bends them."""
        return self

    @property
    def times_finer(self) -> float:
        """How many times as fine as usual the shrunk images are, at least 1."""
        return times_finer((self.plain.height, self.plain.width))

    @classmethod
    def of(cls, image_size: tuple[int, int], longer_side: int) -> WorkingSize:
        """Return the size whose longer side is at most ``longer_side``; images are never enlarged."""
        factor = min(1.0, longer_side / max(image_size))
        height, width = (max(1, round(factor * side)) for side in image_size)
        return cls(height, width, image_size)

    @property
    def scale(self) -> tuple[float, float]:
        """Working pixels per image pixel, along u and v."""
        return self.width / self.image_size[1], self.height / self.image_size[0]

    def intrinsics(self, intrinsics: FloatArray) -> FloatArray:
        """Return fx, fy, cx, cy (4,) at this size."""
        x, y = self.scale
        fx, fy, cx, cy = intrinsics
        return np.array([fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5])

    def pixels(self, uv: FloatArray) -> FloatArray:
        """Return image pixels (N, 2) in working pixels."""
        return np.asarray((uv + 0.5) * np.asarray(self.scale) - 0.5, dtype=np.float64)

    def shrink(self, values: Float32Array) -> Float32Array:
        """Return a map (H, W) at this size, averaged over areas."""
        small = cv2.resize(values, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.float32)

    def depth(self, depth: Float32Array) -> Float32Array:
        """Return a depth map (H, W) at this size: inverse depth averaged within surfaces, one pixel's across edges."""
        sides = (self.width, self.height)
        picked = cv2.resize(depth, sides, interpolation=cv2.INTER_NEAREST)
        known = np.isfinite(depth)
        share = cv2.resize(known.astype(np.float32), sides, interpolation=cv2.INTER_AREA)
        inverse = cv2.resize(np.where(known, 1.0 / depth, np.float32(0)), sides, interpolation=cv2.INTER_AREA)
        return on_one_surface(picked, share, inverse)

    def marked(self, mask: Int32Array) -> BoolArray:
        """Return where any pixel of a mask (H, W) is set, at this size."""
        small = cv2.resize((mask > 0).astype(np.float32), (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(small > 1e-3)

    def enlarge(self, values: Float32Array) -> Float32Array:
        """Return a map of this size as (H, W), bilinear."""
        large = cv2.resize(values, (self.image_size[1], self.image_size[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(large, dtype=np.float32)

    def shown(self, values: MapT) -> MapT:
        """Return a map of this size as the shrunk image shows it."""
        return values

    def straight(self, mask: BoolArray) -> BoolArray:
        """Return a mask of the shrunk image as one of this size; what the image does not show is not in it."""
        return mask

    def within(self, values: MapT, otherwise: float) -> MapT:
        """Return a map of this size with another value where the image shows nothing."""
        return values

    def continued(self, values: Float32Array) -> Float32Array:
        """Return a map of this size with the value of the nearest pixel where the image shows nothing."""
        return values


def on_one_surface(picked: Float32Array, share: Float32Array, inverse: Float32Array) -> Float32Array:
    """Return mean depth where one pixel's is like it, else that pixel's, (h, w).

    Args:
        picked: (h, w) depth of one pixel, m.
        share: (h, w) part of the pixels whose depth is known.
        inverse: (h, w) mean inverse depth, 0 counted where it is not known.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = share / inverse
        alike = np.abs(np.log(mean / picked)) < ONE_SURFACE
    return np.asarray(np.where(alike, mean, picked), dtype=np.float32)


@dataclass(frozen=True)
class WorkingFrame:
    """One frame, ready to be matched."""

    gray: Float32Array
    """(h, w), 0 to 1; beyond what the image shows it goes on."""
    static: Float32Array
    """(h, w) the same, NaN where something moves and where the image shows nothing."""
    matched: Float32Array
    """(h, w) the same, NaN where other frames find nothing of theirs."""


def working_frame(
    image: ImageArray, mask: Int32Array, size: WorkingSize, band_px: int, *, hides: bool = True
) -> WorkingFrame:
    """Shrink a frame, and take out what moves, with a band around it.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        size: Where to.
        band_px: Width of the band, working px.
        hides: Whether other frames are not matched with what the mask marks.
    """
    gray = size.shrink(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float32)) / np.float32(255.0)
    static = size.within(without_band(~size.marked(mask), band_px), False)
    without = np.where(static, gray, np.float32(np.nan))
    return WorkingFrame(gray, without, without if hides else size.within(gray, np.nan))


def without_band(unmasked: BoolArray, band_px: int) -> BoolArray:
    """Return the pixels (h, w) outside of masks and of a band of this width around them, px."""
    if band_px <= 0 or unmasked.all():
        return unmasked
    return np.asarray(cv2.erode(unmasked.astype(np.uint8), np.ones((2 * band_px + 1,) * 2, np.uint8)) > 0)
