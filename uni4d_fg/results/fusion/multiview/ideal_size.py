"""The working size of images that a lens bends: maps lie on ideal pixels, those of a pinhole, as matching needs it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.results.fusion.multiview.working_frame import ONE_SURFACE, MapT, WorkingSize, on_one_surface

_LEAST_FACTOR = 0.5
"""A lens for which the focal length has to shrink by more leaves too few pixels in the middle."""
_ANY = 1e-3
_SAME_PX = 0.1
"""Ideal pixels that do not come back to themselves by as much lie past the lens's fold."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IdealSize(WorkingSize):
    """A working size whose maps are those of a pinhole that sees all that the images show, and some that they do not.

    Made by :func:`ideal_size`.
    """

    lens: Lens
    camera: FloatArray
    """(4,) intrinsics of the images at working size, px."""
    to_real: Float32Array
    """(h, w, 2) where the shrunk image shows each pixel, working px; far outside of it where it does not."""
    to_ideal: Float32Array
    """(h, w, 2) where each pixel of the shrunk image is, working px."""
    from_image: Float32Array
    """(H, W, 2) where each pixel of the image is, working px."""
    inside: BoolArray
    """(h, w) pixels that the image shows."""
    nearest: IntArray
    """(h, w) of each pixel the nearest one that the image shows, as a number."""

    @property
    def plain(self) -> WorkingSize:
        """That of the shrunk images."""
        return WorkingSize(self.height, self.width, self.image_size)

    def pixels(self, uv: FloatArray) -> FloatArray:
        """Return image pixels (N, 2) in working pixels, ideal ones; far outside if no direction reaches them."""
        center = self.camera[2:]
        ideal = self.lens.ideal_pixels(self.camera, super().pixels(uv))
        return np.nan_to_num(center + self.factor * (ideal - center), nan=-1e6)

    def shrink(self, values: Float32Array) -> Float32Array:
        """Return a map (H, W) at this size; where the image does not reach, it goes on."""
        return self.continued(_sampled(super().shrink(values), self.to_real))

    def depth(self, depth: Float32Array) -> Float32Array:
        """Return a depth map (H, W) at this size, as the plain one does; NaN where the image does not reach."""
        small = super().depth(depth)
        known = np.isfinite(small)
        picked = _picked(small, self.to_real, np.nan)
        share = _sampled(known.astype(np.float32), self.to_real)
        inverse = _sampled(np.where(known, 1.0 / small, np.float32(0)), self.to_real)
        return on_one_surface(picked, share, inverse)

    def marked(self, mask: Int32Array) -> BoolArray:
        """Return where any pixel of a mask (H, W) is set, at this size."""
        return np.asarray(_sampled(super().marked(mask).astype(np.float32), self.to_real) > _ANY) & self.inside

    def enlarge(self, values: Float32Array) -> Float32Array:
        """Return a map of this size as (H, W), bilinear."""
        return _sampled(values, self.from_image)

    def shown(self, values: MapT) -> MapT:
        """Return a map of this size as the shrunk image shows it: bilinear within surfaces, one pixel's elsewhere."""
        if values.dtype == np.bool_:
            return np.asarray(_picked(values.astype(np.uint8), self.to_ideal, 0) > 0, values.dtype)
        picked = _picked(values, self.to_ideal, np.nan)
        mean = cv2.remap(values, self.to_ideal, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        with np.errstate(invalid="ignore"):
            return np.where(np.abs(mean - picked) < ONE_SURFACE, mean, picked)

    def straight(self, mask: BoolArray) -> BoolArray:
        """Return a mask of the shrunk image as one of this size; what the image does not show is not in it."""
        return np.asarray(_picked(mask.astype(np.uint8), self.to_real, 0) > 0)

    def within(self, values: MapT, otherwise: float) -> MapT:
        """Return a map of this size with another value where the image shows nothing."""
        return np.where(self.inside, values, values.dtype.type(otherwise))

    def continued(self, values: Float32Array) -> Float32Array:
        """Return a map of this size with the value of the nearest pixel where the image shows nothing."""
        return np.asarray(values.ravel()[self.nearest], dtype=np.float32)


def ideal_size(plain: WorkingSize, lens: Lens, intrinsics: FloatArray) -> WorkingSize | None:
    """Return the working size of images that a lens bends; None if it is too wide for a pinhole.

    The focal length shrinks until all that the image shows fits in. It never grows, as no pixels would be gained.

    Args:
        plain: That of a pinhole's images, which is returned for a pinhole.
        lens: Of the images.
        intrinsics: (4,) px, of the images.
    """
    if lens.is_pinhole:
        return plain
    camera = plain.intrinsics(intrinsics)
    center = camera[2:]
    last = np.array([plain.width - 1, plain.height - 1], dtype=np.float64)
    grid = np.stack(np.meshgrid(np.arange(plain.width), np.arange(plain.height)), axis=-1).astype(np.float64)
    away = lens.ideal_pixels(camera, grid) - center
    factor = _fitting(away, center, last) if np.isfinite(away).all() else 0.0
    if factor < _LEAST_FACTOR:
        return None
    ideal = center + (grid - center) / factor
    real = lens.real_pixels(camera, ideal)
    # Beyond its fold a lens would show things twice.
    with np.errstate(invalid="ignore"):
        same = np.abs(lens.ideal_pixels(camera, real) - ideal).max(axis=-1) < _SAME_PX
    inside: BoolArray = same & (real > -0.5).all(axis=-1) & (real < last + 0.5).all(axis=-1)
    to_ideal = (center + factor * away).astype(np.float32)
    height, width = plain.image_size
    return IdealSize(
        plain.height,
        plain.width,
        plain.image_size,
        factor,
        lens=lens,
        camera=camera,
        to_real=np.where(inside[..., None], np.clip(real, 0, last), -1e4).astype(np.float32),
        to_ideal=to_ideal,
        from_image=np.asarray(cv2.resize(to_ideal, (width, height), interpolation=cv2.INTER_LINEAR), np.float32),
        inside=inside,
        nearest=_nearest(inside),
    )


def _fitting(away: FloatArray, center: FloatArray, last: FloatArray) -> float:
    """Return the factor, 1 at most, that brings all pixels, given from the center, between the first and the last."""
    room = np.where(away > 0, last - center, center)
    return float(np.min(room / np.maximum(np.abs(away), 1e-9), initial=1.0))


def _nearest(inside: BoolArray) -> IntArray:
    """Return the number of the nearest pixel that is inside, (h, w)."""
    _, labels = cv2.distanceTransformWithLabels(
        (~inside).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    number_of: IntArray = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    number_of[labels[inside]] = np.flatnonzero(inside)
    return np.asarray(number_of[labels])


def _sampled(values: Float32Array, at: Float32Array) -> Float32Array:
    """Return a map between its pixels, bilinear; beyond it goes on as at its border."""
    return np.asarray(cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _picked(values: MapT, at: Float32Array, beyond: float) -> MapT:
    """Return a map's nearest pixels, and another value beyond it."""
    picked = cv2.remap(values, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond)
    return np.asarray(picked, values.dtype)
