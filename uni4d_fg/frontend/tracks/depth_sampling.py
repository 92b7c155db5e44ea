"""Depth at sub-pixel positions, without mixing foreground and background."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array


def sample_depth(
    depth: Float32Array,
    uv: Float32Array,
    min_depth_m: float,
    max_depth_m: float,
    max_relative_spread: float,
) -> Float32Array:
    """Sample a depth map at sub-pixel positions.

    The four pixels around a position are interpolated bilinearly when all are valid and their largest and
    smallest depth differ by no more than ``max_relative_spread`` of the smallest. When the position straddles
    a discontinuity there is no telling which side it belongs to, and the sample is missing. Beside a hole the
    nearest pixel is taken if it is valid and the valid ones agree in the same sense.

    Args:
        depth: (H, W) meters, NaN where missing.
        uv: (N, 2) finite pixels; positions outside the pixel centers are moved to the nearest one.
        min_depth_m: Smaller depth is missing, meters.
        max_depth_m: Larger depth is missing, meters.
        max_relative_spread: Largest relative difference that is still one surface.

    Returns:
        (N,) float32 meters, NaN where missing.
    """
    height, width = depth.shape
    x = np.clip(uv[:, 0].astype(np.float64), 0, width - 1)
    y = np.clip(uv[:, 1].astype(np.float64), 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    weights = np.stack(((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy))
    corners = np.stack((depth[top, left], depth[top, right], depth[bottom, left], depth[bottom, right])).astype(
        np.float64
    )

    valid = (corners >= min_depth_m) & (corners <= max_depth_m)  # False for NaN
    nearest = weights.argmax(axis=0)
    columns = np.arange(len(nearest))
    smallest = np.where(valid, corners, np.inf).min(axis=0, initial=np.inf)
    largest = np.where(valid, corners, -np.inf).max(axis=0, initial=-np.inf)
    one_surface = largest <= smallest * (1 + max_relative_spread)
    bilinear = (weights * np.where(valid, corners, 0.0)).sum(axis=0)
    value = np.where(valid.all(axis=0), bilinear, corners[nearest, columns])
    usable = one_surface & valid[nearest, columns]
    return np.where(usable, value, np.nan).astype(np.float32)
