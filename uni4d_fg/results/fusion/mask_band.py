"""Which pixels beside masks look like the moving thing, as masks may be too small, and which inside stand still."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, Int32Array

_AROUND_PX = 4.0
"""Standard deviation of the window whose colors a pixel is compared with, working px."""
_COLOR_NOISE = 1e-3
"""Least variance of colors, of 1."""
_NONE_AROUND = 0.01
"""A window that holds less than this part of a region says nothing of it."""
_WHOLE = 0.99
STILL = 0.6
"""Pixels of a mask whose depth several frames show with this confidence are taken to stand still."""
_RIM_PX = 2.0
_RIM_STILL = 0.1
"""A mask is too large if so much of its rim, that wide, stands still: of masks that fit, a fiftieth seems to."""
_REACH_PX = 6.0
"""Masks that are too large reach no farther beyond what moves, working px."""
_USUAL = 0.15
"""Nine tenths of the pixels that move have a confidence below 0.25."""
_LARGEST_LIKELIHOOD = 4.0
"""Neighboring colors are not as independent as their likelihood takes them to be."""
_EVIDENCE = 1.5


def looks_moving(image: ImageArray, mask: Int32Array, static: BoolArray) -> BoolArray:
    """Compare every pixel with the colors inside masks and outside of the band nearby, each a normal distribution.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        static: (h, w), at the working size: neither masked nor in the band.

    Returns:
        (h, w) where the colors inside a mask are the likelier ones, among pixels that are not static.
    """
    small, inside = _shrunk(image, mask, static.shape)
    if not inside.any():
        return np.zeros_like(static)
    return ~static & (_log_likelihood(small, inside) > _log_likelihood(small, static))


def stands_still(image: ImageArray, mask: Int32Array, matched: Float32Array, static: BoolArray) -> BoolArray:
    """Return which pixels inside masks stand still, as masks reach beyond what moves.

    What several frames show with confidence does. Where that is much of a mask's rim, the mask is too large, and the
    pixels along it are judged by both their confidence and their colors, compared with those deeper inside and outside.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        matched: (h, w) confidence in the depth that several frames show of what stands still.
        static: (h, w) neither masked nor in the band around masks.

    Returns:
        (h, w), whatever outside of masks.
    """
    still = matched > STILL
    small, inside = _shrunk(image, mask, static.shape)
    if not inside.any():
        return still
    depth = cv2.distanceTransform(np.pad(inside.astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 3)[1:-1, 1:-1]
    rim = inside & (depth <= _RIM_PX)
    deep = inside & (depth > _REACH_PX)
    if not rim.any() or not deep.any() or float(still[rim].mean()) < _RIM_STILL:
        return still
    with np.errstate(invalid="ignore"):
        like_static = np.nan_to_num(_log_likelihood(small, static) - _log_likelihood(small, deep), nan=0.0)
    like_static = np.clip(like_static, -_LARGEST_LIKELIHOOD, _LARGEST_LIKELIHOOD)
    seen = 2 * np.log(np.maximum(matched, np.float32(1e-3)) / np.float32(_USUAL))
    along = inside & (depth <= _REACH_PX)
    return np.asarray(still | (along & (like_static + seen > _EVIDENCE)))


def _shrunk(image: ImageArray, mask: Int32Array, shape: tuple[int, ...]) -> tuple[Float32Array, BoolArray]:
    """Return image (h, w, 3), of 1, and which pixels (h, w) are all inside a mask."""
    sides = (shape[1], shape[0])
    small = cv2.resize(image, sides, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)
    return small, cv2.resize((mask > 0).astype(np.float32), sides, interpolation=cv2.INTER_AREA) > _WHOLE


def _log_likelihood(image: Float32Array, region: BoolArray) -> Float32Array:
    """Return that of each pixel (h, w) of an image (h, w, 3), of 1, under the colors of a region nearby."""
    weight = region.astype(np.float32)
    mass = cv2.GaussianBlur(weight, (0, 0), _AROUND_PX)
    share = np.maximum(mass, 1e-6)[..., None]
    mean = cv2.GaussianBlur(image * weight[..., None], (0, 0), _AROUND_PX) / share
    square = cv2.GaussianBlur(image**2 * weight[..., None], (0, 0), _AROUND_PX) / share
    variance = np.maximum(square - mean**2, 0) + np.float32(_COLOR_NOISE)
    value = -0.5 * ((image - mean) ** 2 / variance + np.log(variance)).sum(axis=2)
    return np.where(mass > _NONE_AROUND, value, np.float32(-np.inf)).astype(np.float32)
