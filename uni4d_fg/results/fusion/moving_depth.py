"""Depth of what moves in one frame: the cue as the scene around has corrected it, then by the instance's trajectories.

The error of a network's depth is smooth over the image, so that what the static scene says of it holds for the things
in front of it as well. What trajectories say besides is a smooth field over the instance. Where the cue mixes the
instance with what lies behind it, its depth is continued from farther inside.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.cues.dense_flow import DenseFlow, shrunk_gray, warp_back
from uni4d_fg.results.fusion.carried import filled_smoothly
from uni4d_fg.results.fusion.cue_error import smooth_field_of_points
from uni4d_fg.results.fusion.wide_window import blurred
from uni4d_fg.robust import robust_sigma

_POINT_WEIGHT = 0.5
"""Of a trajectory's point, where a window full of sure pixels has one per pixel."""
_WRONG = 0.25
"""A point whose log depth departs farther from the instance's usual departure is wrong."""
_USUAL_SIGMA = 0.05
"""Standard deviation of what trajectories take from the depth of an instance, which the scene around it has corrected,
before they are seen."""
_INDEPENDENT = 3
"""Points of one instance are wrong together: they say no more than this many on their own."""
_WHOLE = 0.99
"""Part of the pixels between which depth is carried that have to be the instance's."""
_WINDOW_SIGMAS = 4.0
"""Half a Gaussian window, of its standard deviation."""
_BLED = 0.03
"""Change of log depth towards the border of a mask from which on it may come from what lies behind."""


def correct_moving(
    log_depth: Float32Array,
    pixels: BoolArray,
    uv: FloatArray,
    log_z: FloatArray,
    radius_px: float,
    config: FusionConfig,
) -> Float32Array:
    """Correct an instance's depth by its trajectories, (H, W); elsewhere it is as given.

    Args:
        log_depth: (H, W) corrected by the static scene, NaN where missing.
        pixels: (H, W) where the instance is.
        uv: (N, 2) px, its points in this frame.
        log_z: (N,) their log depth.
        radius_px: How far the cue bleeds, px: points nearer to the instance's border, which had their depth from the
            cue as well, say nothing.
        config: Fewest points, windows and prior.
    """
    height, width = log_depth.shape
    column, row = np.clip(np.rint(uv), 0, (width - 1, height - 1)).astype(np.int64).T
    on_it = np.flatnonzero(pixels[row, column])
    row, column, log_z = row[on_it], column[on_it], log_z[on_it]
    left = log_z - log_depth[row, column]
    good = np.isfinite(left)
    if radius_px > 0:
        good &= _inside(pixels)[row, column] > radius_px
    if np.count_nonzero(good) < config.min_control_points:
        return log_depth
    usual = float(np.median(left[good]))
    apart = robust_sigma(left[good] - usual)
    share = _USUAL_SIGMA**2 / (_USUAL_SIGMA**2 + apart**2 / min(int(np.count_nonzero(good)), _INDEPENDENT))
    good &= np.abs(left - usual) < _WRONG
    at = row[good], column[good]
    field = smooth_field_of_points(at, left[good] - usual, _POINT_WEIGHT, (height, width), config)
    return np.where(pixels, log_depth + np.float32(share) * (np.float32(usual) + field), log_depth)


def _inside(pixels: BoolArray) -> Float32Array:
    """Return how far each pixel of an instance is from its border, px, (H, W)."""
    return np.asarray(cv2.distanceTransform(np.pad(pixels.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1])


def without_bleeding(log_depth: Float32Array, pixels: BoolArray, radius_px: float) -> Float32Array:
    """Continue an instance's depth from inside where a cue that bleeds has mixed it with what is behind, (H, W).

    Args:
        log_depth: (H, W), NaN where missing.
        pixels: (H, W) where the instance is.
        radius_px: How far the cue bleeds across edges, px; 0 changes nothing.
    """
    if radius_px <= 0 or not pixels.any():
        return log_depth
    sigma = 0.7 * radius_px
    box = _box_around(pixels, int(np.ceil(_WINDOW_SIGMAS * sigma)))
    here, pixels = log_depth[box], pixels[box]
    inside = _inside(pixels)
    deepest = float(inside.max())
    share = np.clip(inside / np.float32(min(radius_px, 0.7 * deepest)), 0, 1)
    known = pixels & np.isfinite(here)
    weight = np.where(known, share**6 + np.float32(1e-6), np.float32(0))
    values = np.where(known, here, np.float32(0))
    around = blurred(np.dstack((weight * values, weight)), sigma)
    mean = around[..., 0] / np.maximum(around[..., 1], 1e-12)
    bled = known & (share < 1) & (values - mean > _BLED * (1 - share))
    out = log_depth.copy()
    out[box] = np.where(bled, mean, here)
    return out


def _box_around(pixels: BoolArray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of an instance, with a margin where the image has one."""
    ends = (np.flatnonzero(pixels.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(0, at[0] - margin), at[-1] + margin + 1) for at in ends)
    return rows, columns


def carried_moving(
    pixels: BoolArray, image: ImageArray, others: list[tuple[ImageArray, Float32Array, BoolArray, float]]
) -> Float32Array:
    """Return an instance's log depth as frames beside show it, carried by optical flow, (H, W).

    Args:
        pixels: (H, W) where the instance is; NaN elsewhere.
        image: (H, W, 3) RGB.
        others: Image, log depth (H, W), the instance's pixels there and a weight, of each other frame.
    """
    total, weights = np.zeros(pixels.shape, np.float32), np.zeros(pixels.shape, np.float32)
    dense, size = DenseFlow(), image.shape[:2]
    for other, log_depth, there, weight in others:
        flow = dense.between(shrunk_gray(image, size), shrunk_gray(other, size))
        known = (there & np.isfinite(log_depth)).astype(np.float32)
        share = warp_back(known, flow)
        seen = warp_back(np.where(known > 0, log_depth, np.float32(0)), flow)
        sure = pixels & (share > _WHOLE)
        total += np.where(sure, weight * seen / np.maximum(share, _WHOLE), np.float32(0))
        weights += np.where(sure, np.float32(weight), np.float32(0))
    if not weights.any():
        return np.full(pixels.shape, np.nan, np.float32)
    mean = (total / np.maximum(weights, 1e-6)).astype(np.float32)
    filled = filled_smoothly(mean, weights > 0)
    return np.where(pixels, filled, np.float32(np.nan))
