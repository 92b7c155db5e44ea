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
from uni4d_fg.results.fusion.cue_error import smooth_field

_POINT_WEIGHT = 0.5
"""Of a trajectory's point, where a window full of sure pixels has one per pixel."""
_WRONG = 0.25
"""A point whose log depth departs farther from the instance's usual departure is wrong."""
_WHOLE = 0.99
"""Part of the pixels between which depth is carried that have to be the instance's."""
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
    left = log_z - log_depth[row, column]
    inside = cv2.distanceTransform(np.pad(pixels.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    good = np.isfinite(left) & pixels[row, column] & (inside[row, column] > radius_px)
    if np.count_nonzero(good) < config.min_control_points:
        return log_depth
    usual = float(np.median(left[good]))
    good &= np.abs(left - usual) < _WRONG
    weight, residual = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    weight[row[good], column[good]] = _POINT_WEIGHT
    residual[row[good], column[good]] = left[good] - usual
    field = usual + smooth_field(residual, weight, config)
    return np.where(pixels, log_depth + field, log_depth).astype(np.float32)


def without_bleeding(log_depth: Float32Array, pixels: BoolArray, radius_px: float) -> Float32Array:
    """Continue an instance's depth from inside where a cue that bleeds has mixed it with what is behind, (H, W).

    Args:
        log_depth: (H, W), NaN where missing.
        pixels: (H, W) where the instance is.
        radius_px: How far the cue bleeds across edges, px; 0 changes nothing.
    """
    if radius_px <= 0 or not pixels.any():
        return log_depth
    inside = cv2.distanceTransform(np.pad(pixels.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    deepest = float(inside.max())
    share = np.clip(inside / np.float32(min(radius_px, 0.7 * deepest)), 0, 1)
    known = pixels & np.isfinite(log_depth)
    weight = np.where(known, share**6 + np.float32(1e-6), np.float32(0))
    values = np.where(known, log_depth, np.float32(0))
    sigma = 0.7 * radius_px
    mean = cv2.GaussianBlur(weight * values, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-12)
    bled = known & (share < 1) & (values - mean > _BLED * (1 - share))
    return np.where(bled, mean, log_depth).astype(np.float32)


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
