"""Edges of depth brought to those of the image, where depth is not sure: a weighted median of the surfaces around.

A pixel that is not sure takes the median of the depths around, weighted by how near they are, by how much their color
is like its own, and by how sure they are (Ma et al. 2013, "Constant time weighted median filtering for stereo matching
and beyond"). Unlike a mean, a median of two surfaces is one of them. Each pixel around stands for the plane through it,
continued to the pixel in question: else ground that goes far, sure where it is near, would come nearer. The inverse
depth of a plane is linear in the image, so that a slope is all that a plane needs.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.matching_size import times_finer

_UNSURE = 0.5
"""Pixels of a lower confidence are replaced."""
_STEPS, _STEP_PX = 3, 4.0
"""So many pixels to each side are looked at, one in four: rims of what is near are up to ten wide (working px of the
usual size, as all that follows)."""
_SPATIAL_PX = 6.0
"""Standard deviation of the weights by distance ..."""
_COLOR = 0.05
"""... and of those by color, of 1."""
_LEAST = np.float32(1e-3)
"""Weight of depth that is not sure at all, beside that of sure depth."""
_FARTHEST = np.float32(60.0)
"""Exponent beyond which pixels are equally unlike."""
_STEEPEST = np.float32(0.3)
"""A plane changes inverse depth by at most this part on its way to a pixel."""
_SLOPE_PX = 5
"""Slopes are means over windows of this half side ..."""
_ONE_SURFACE = np.float32(0.05)
"""... of the differences of neighbors whose log depth differs by less."""


def guided_median(
    log_depth: Float32Array, confidence: Float32Array, static: BoolArray, image: ImageArray
) -> Float32Array:
    """Return log depth (h, w) with what is not sure taken from what looks alike around it.

    Args:
        log_depth: (h, w), NaN where missing; stays missing there.
        confidence: (h, w) probability that it is right.
        static: (h, w) where that may be done: masks may be smaller than what moves, and what is beside them is left.
        image: (H, W, 3) RGB, not smaller.
    """
    height, width = log_depth.shape
    known = np.isfinite(log_depth)
    chosen = known & static & (confidence < _UNSURE)
    if not chosen.any():
        return log_depth
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    colors = small.astype(np.float32) / np.float32(255 * np.sqrt(2.0) * _COLOR)
    weights = np.where(known, confidence + _LEAST, np.float32(0)).astype(np.float32)
    inverse = np.exp(-np.where(known, log_depth, np.float32(0))).astype(np.float32)
    slopes = _slopes(inverse, weights)
    finer = times_finer(inverse.shape)
    step = round(_STEP_PX * finer)
    reach, spatial = _STEPS * step, _SPATIAL_PX * finer
    core, _ = find_extension()
    if core is None:
        found = guided_median_numpy(inverse, weights, slopes, colors, chosen, reach, step, spatial)
    else:
        found = core.guided_median(
            inverse, weights, slopes, colors, chosen.astype(np.uint8), reach=reach, step=step, spatial=spatial,
            steepest=float(_STEEPEST),
        )  # fmt: skip
    return np.where(chosen, -np.log(found), log_depth)


def _slopes(inverse: Float32Array, weights: Float32Array) -> Float32Array:
    """Return by what part inverse depth grows from a pixel to the one below and to the one on its right, (h, w, 2).

    Args:
        inverse: (h, w) inverse depth, positive.
        weights: (h, w), 0 where it is missing.
    """
    limit = 1 + _ONE_SURFACE
    window = (2 * round(_SLOPE_PX * times_finer(inverse.shape)) + 1,) * 2
    slopes = np.zeros((*inverse.shape, 2), np.float32)
    for axis in (0, 1):
        # Neighbors, along the axis; the last row or column has none.
        here, there = (slice(None, -1), slice(1, None)) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        one, other = inverse[here], inverse[there]
        sure = np.minimum(weights[here], weights[there]) * ((other < limit * one) & (one < limit * other))
        grows, total = np.zeros_like(inverse), np.zeros_like(inverse)
        grows[here], total[here] = sure * (other - one), sure
        mean = cv2.blur(grows, window) / np.maximum(cv2.blur(total, window), _LEAST)
        slopes[..., axis] = mean / inverse
    return slopes


def guided_median_numpy(
    values: Float32Array, weights: Float32Array, slopes: Float32Array, colors: Float32Array, chosen: BoolArray,
    reach: int, step: int, spatial: float,
) -> Float32Array:  # fmt: skip
    """Do what ``cpp_factors/src/guided_median.cpp`` does.

    Args:
        values: (h, w), finite where they weigh anything.
        weights: (h, w), 0 where the map is missing.
        slopes: (h, w, 2) by what part values grow from a pixel to the one below and to the one on its right.
        colors: (h, w, 3) in units of sqrt(2) standard deviations of the weights by color.
        chosen: (h, w) pixels that take the median.
        reach: Half side of the window, px, ...
        step: ... of which one pixel in so many is looked at, along rows and columns.
        spatial: Standard deviation of the weights by distance, px.
    """
    height, width = values.shape
    row, column = np.nonzero(chosen)
    color, weight, slope = colors.reshape(-1, 3), weights.ravel(), slopes.reshape(-1, 2)
    value, own = np.where(weights > 0, values, np.float32(0)).ravel(), color[row * width + column]
    taps = range(-reach, reach + 1, step)
    around = np.empty((len(taps) ** 2, row.size), np.float32)
    weighed = np.empty_like(around)
    for number, (dy, dx) in enumerate((dy, dx) for dy in taps for dx in taps):
        inside = (row + dy >= 0) & (row + dy < height) & (column + dx >= 0) & (column + dx < width)
        at = np.where(inside, (row + dy) * width + column + dx, 0)
        unlike = ((color[at] - own) ** 2).sum(axis=1) + np.float32((dy * dy + dx * dx) / (2 * spatial**2))
        back = -(np.float32(dy) * slope[at, 0] + np.float32(dx) * slope[at, 1])
        around[number] = value[at] * (1 + np.clip(back, -_STEEPEST, _STEEPEST))
        weighed[number] = np.where(inside, weight[at] * np.exp(-np.minimum(unlike, _FARTHEST)), np.float32(0))
    order = np.argsort(around, axis=0)
    mass = np.cumsum(np.take_along_axis(weighed, order, axis=0), axis=0)
    middle = np.argmax(mass >= 0.5 * mass[-1:], axis=0)
    out = values.copy()
    out[row, column] = around[order[middle, np.arange(row.size)], np.arange(row.size)]
    return out
