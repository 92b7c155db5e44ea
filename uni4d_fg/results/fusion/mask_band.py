"""Which pixels beside masks look like the moving thing, as masks may be too small, and which inside stand still."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, Int32Array
from uni4d_fg.results.fusion.background import Background

_AROUND_PX = 4.0
"""Standard deviation of the window whose colors a pixel is compared with, working px."""
_COLOR_NOISE = 1e-3
"""Least variance of colors, of 1."""
_NONE_AROUND = 0.01
"""A window that holds less than this part of a region says nothing of it."""
_WHOLE = 0.99
STILL = 0.6
"""Pixels of a mask whose depth several frames show with this confidence are taken to stand still."""
_RIM_PX, _RIM_STILL, _MIN_RIM = 2, 0.5, 20
"""A mask is too large if so much of its rim, that wide, looks like what is behind: of masks that fit 0 to 0.3 does, of
others 0.6 to 1. With fewer pixels that others see, it is not told."""
_REACH_PX = 6.0
"""Colors of what moves are those farther inside, working px."""
_FARTHEST_PX = 12
"""Masks that are too large reach no farther beyond what moves, working px."""
_USUAL = 0.15
"""Nine tenths of the pixels that move have a confidence below 0.25."""
_LARGEST, _PER_COLOR, _PER_CONFIDENCE = 8.0, 0.3, 0.13
"""Log likelihood ratio of colors at most, and what it and confidence count: fitted to scenes with truth."""
_TRANSFER_NOISE = 2e-3
"""Variance of colors that are looked up in other frames, of 1."""


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


def stands_still(
    image: ImageArray, mask: Int32Array, matched: Float32Array, static: BoolArray, behind: Background
) -> BoolArray:
    """Return which pixels inside masks stand still, as masks reach beyond what moves.

    What several frames show with confidence does. Where the rim of a mask looks like what other frames show of the
    still scene, the mask is too large. By how much is seen in how many pixels look so, the farther inside the fewer;
    each is then judged by that share, by its own colors, and by its confidence.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        matched: (h, w) confidence in the depth that several frames show of what stands still.
        static: (h, w) neither masked nor in the band around masks.
        behind: What other frames show of the still scene there.

    Returns:
        (h, w), whatever outside of masks.
    """
    still = matched > STILL
    small, inside = _shrunk(image, mask, static.shape)
    if not inside.any():
        return still
    depth = cv2.distanceTransform(np.pad(inside.astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 3)[1:-1, 1:-1]
    deep = inside & (depth > _REACH_PX)
    ring = np.ceil(depth).astype(np.int64)
    along = inside & (ring <= _FARTHEST_PX)
    seen = along & behind.seen
    if not deep.any() or np.count_nonzero(seen & (ring <= _RIM_PX)) < _MIN_RIM:
        return still
    like_behind = _like_background(small, behind) - _log_likelihood(small, deep)
    # Where nothing deeper inside is near, the colors say nothing.
    told = seen & np.isfinite(like_behind)
    like_behind = np.where(told, np.clip(like_behind, -_LARGEST, _LARGEST), np.float32(0))
    if float((like_behind[seen & (ring <= _RIM_PX)] > 0).mean()) < _RIM_STILL:
        return still
    many = np.bincount(ring[seen], minlength=_FARTHEST_PX + 1) + 1.0
    share = np.bincount(ring[seen & (like_behind > 0)], minlength=_FARTHEST_PX + 1) / many
    share = np.clip(np.minimum.accumulate(np.append(1.0, share[1:])), 0.02, 0.98)
    # Farther inside than the mask is too large, what looks like the scene behind only looks like it.
    along &= ring <= np.count_nonzero(share >= _RIM_STILL)
    odds = np.log(share / (1 - share))[np.minimum(ring, _FARTHEST_PX)]
    confident = 2 * np.log(np.maximum(matched, np.float32(1e-3)) / np.float32(_USUAL))
    return np.asarray(still | (along & (odds + _PER_COLOR * like_behind + _PER_CONFIDENCE * confident > 0)))


def _like_background(image: Float32Array, behind: Background) -> Float32Array:
    """Return the log likelihood (h, w) of an image (h, w, 3), of 1, if what other frames show is there."""
    off = cv2.GaussianBlur(image - behind.color, (0, 0), 1.0)
    variance = cv2.GaussianBlur(behind.variance, (0, 0), 1.0) + np.float32(_TRANSFER_NOISE)
    return np.asarray(-0.5 * (off**2 / variance + np.log(variance)).sum(axis=2), np.float32)


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
