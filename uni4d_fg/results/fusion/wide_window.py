"""Means over wide Gaussian windows, taken on a grid that is coarse beside them."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array

_NODES = 4
"""Nodes of a grid per standard deviation of the window that is taken on it, at least."""


def blurred(values: Float32Array, sigma: float) -> Float32Array:
    """Return means over Gaussian windows, which are reflected at the borders, of the same shape.

    Args:
        values: (h, w) or (h, w, channels), finite.
        sigma: Standard deviation of the window, px.
    """
    shape = values.shape[:2]
    size = nodes(sigma, shape)
    around = cv2.GaussianBlur(averaged(values, size), (0, 0), sigma_on(size, sigma, shape))
    return resized(np.asarray(around, np.float32), shape)


def nodes(sigma: float, shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the size of a grid over a map (h, w) that is fine beside a window."""
    step = max(1, int(sigma / _NODES))
    return max(1, round(shape[0] / step)), max(1, round(shape[1] / step))


def sigma_on(size: tuple[int, ...], sigma: float, shape: tuple[int, ...]) -> float:
    """Return the standard deviation, in nodes, that makes a window of ``sigma`` px of a map (h, w) on a grid."""
    if size[:2] == shape[:2]:
        return sigma
    # Blocks and interpolation between nodes widen a window by themselves.
    return float(np.sqrt(max((sigma * size[1] / shape[1]) ** 2 - 0.25, 0.1)))


def averaged(values: Float32Array, size: tuple[int, ...]) -> Float32Array:
    """Return a map as means over the blocks of a grid of this size."""
    if values.shape[:2] == size:
        return values
    return np.asarray(cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_AREA), dtype=np.float32)


def resized(values: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Return what a grid says of every pixel of a map (h, w), linear between nodes."""
    if values.shape[:2] == shape[:2]:
        return values
    return np.asarray(cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
