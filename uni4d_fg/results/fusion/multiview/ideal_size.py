"""The working size of images that a lens bends: maps lie on ideal pixels, those of a pinhole, as matching needs it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.results.fusion.multiview.working_frame import ONE_SURFACE, MapT, WorkingSize, on_one_surface
from uni4d_fg.results.nearest import nearest_known

_MOST_PIXELS = 3.0
"""A lens for which a pinhole needs more than this many times the pixels is not undone."""
_ANY = 1e-3
_SAME_PX = 0.1
"""Ideal pixels that do not come back to themselves by as much lie past the lens's fold."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IdealSize(WorkingSize):
    """A working size whose maps are those of a pinhole that sees all that the images show, and some that they do not.

    Made by :func:`ideal_size`.
    """

    lens: Lens
    shrunk: WorkingSize
    """Of the images, without regard to the lens."""
    camera: FloatArray
    """(4,) intrinsics of the shrunk images, px."""
    shift: FloatArray
    """(2,) of the principal point from there to these maps, px."""
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
        return self.shrunk

    @property
    def scale(self) -> tuple[float, float]:
        """Working pixels per image pixel, along u and v, at the principal point."""
        return self.shrunk.scale

    def intrinsics(self, intrinsics: FloatArray) -> FloatArray:
        """Return fx, fy, cx, cy (4,) of these maps."""
        fx, fy, *center = self.shrunk.intrinsics(intrinsics)
        return np.array([fx, fy, *(center + self.shift)])

    def pixels(self, uv: FloatArray) -> FloatArray:
        """Return image pixels (N, 2) in working pixels, ideal ones; far outside if no direction reaches them."""
        ideal = self.lens.ideal_pixels(self.camera, self.shrunk.pixels(uv))
        return np.asarray(np.nan_to_num(ideal + self.shift, nan=-1e6))

    def shrink(self, values: Float32Array) -> Float32Array:
        """Return a map (H, W) at this size, bicubic; where the image does not reach, it goes on."""
        # Bilinear images are blurred, and matched worse.
        small = self.shrunk.shrink(values)
        bent = cv2.remap(small, self.to_real, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return self.continued(np.asarray(bent, np.float32))

    def depth(self, depth: Float32Array) -> Float32Array:
        """Return a depth map (H, W) at this size, as the plain one does; NaN where the image does not reach."""
        small = self.shrunk.depth(depth)
        known = np.isfinite(small)
        picked = _picked(small, self.to_real, np.nan)
        share = _sampled(known.astype(np.float32), self.to_real)
        inverse = _sampled(np.where(known, 1.0 / small, np.float32(0)), self.to_real)
        return on_one_surface(picked, share, inverse)

    def marked(self, mask: Int32Array) -> BoolArray:
        """Return where any pixel of a mask (H, W) is set, at this size."""
        return np.asarray(_sampled(self.shrunk.marked(mask).astype(np.float32), self.to_real) > _ANY) & self.inside

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

    The focal length is that of the shrunk images, so that the middle keeps its pixels, and all that they show fits in.

    Args:
        plain: That of a pinhole's images, which is returned for a pinhole.
        lens: Of the images.
        intrinsics: (4,) px, of the images.
    """
    if lens.is_pinhole:
        return plain
    camera = plain.intrinsics(intrinsics)
    ideal = lens.ideal_pixels(camera, _grid(plain.height, plain.width))
    if not np.isfinite(ideal).all():
        return None
    first = np.floor(ideal.min(axis=(0, 1)))
    width, height = (float(side) for side in np.ceil(ideal.max(axis=(0, 1))) - first + 1)
    if width * height > _MOST_PIXELS * plain.width * plain.height:
        return None
    to_real, inside = _real(lens, camera, _grid(int(height), int(width)) + first, (plain.width, plain.height))
    to_ideal = (ideal - first).astype(np.float32)
    full = plain.image_size[1], plain.image_size[0]
    return IdealSize(
        int(height),
        int(width),
        plain.image_size,
        lens=lens,
        shrunk=plain,
        camera=camera,
        shift=-first,
        to_real=to_real,
        to_ideal=to_ideal,
        from_image=np.asarray(cv2.resize(to_ideal, full, interpolation=cv2.INTER_LINEAR), np.float32),
        inside=inside,
        nearest=nearest_known(inside),
    )


def _grid(height: int, width: int) -> FloatArray:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)


def _real(lens: Lens, camera: FloatArray, ideal: FloatArray, sides: tuple[int, int]) -> tuple[Float32Array, BoolArray]:
    """Return where an image of a width and height shows ideal pixels (h, w, 2), and whether it does, (h, w)."""
    last = np.array(sides) - 1.0
    real = lens.real_pixels(camera, ideal)
    # Beyond its fold a lens would show things twice.
    with np.errstate(invalid="ignore"):
        same = np.abs(lens.ideal_pixels(camera, real) - ideal).max(axis=-1) < _SAME_PX
    inside: BoolArray = same & (real > -0.5).all(axis=-1) & (real < last + 0.5).all(axis=-1)
    return np.where(inside[..., None], np.clip(real, 0, last), -1e4).astype(np.float32), inside


def _sampled(values: Float32Array, at: Float32Array) -> Float32Array:
    """Return a map between its pixels, bilinear; beyond it goes on as at its border."""
    return np.asarray(cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _picked(values: MapT, at: Float32Array, beyond: float) -> MapT:
    """Return a map's nearest pixels, and another value beyond it."""
    picked = cv2.remap(values, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond)
    return np.asarray(picked, values.dtype)
