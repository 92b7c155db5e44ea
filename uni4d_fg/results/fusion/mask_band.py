"""Which pixels in the band around masks look like the moving thing inside, where a mask may be too small."""

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


def looks_moving(image: ImageArray, mask: Int32Array, static: BoolArray) -> BoolArray:
    """Compare every pixel with the colors inside masks and outside of the band nearby, each a normal distribution.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        static: (h, w), at the working size: neither masked nor in the band.

    Returns:
        (h, w) where the colors inside a mask are the likelier ones, among pixels that are not static.
    """
    sides = (static.shape[1], static.shape[0])
    small = cv2.resize(image, sides, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)
    inside = cv2.resize((mask > 0).astype(np.float32), sides, interpolation=cv2.INTER_AREA) > _WHOLE
    if not inside.any():
        return np.zeros_like(static)
    return ~static & (_log_likelihood(small, inside) > _log_likelihood(small, static))


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
