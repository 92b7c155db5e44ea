"""How much log depth changes around a pixel, where depth may be missing."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray

_BEYOND = np.float32(99.0)
"""Beyond all log depths."""


def log_range(log_depth: Float32Array, window: ImageArray) -> Float32Array:
    """Return the largest minus the smallest log depth in a window around each pixel, (h, w).

    Args:
        log_depth: (h, w), NaN or infinite where missing; such pixels do not count. Means nothing where all are missing.
        window: (k, k) uint8, 1 where the window reaches.
    """
    known = np.isfinite(log_depth)
    farthest = cv2.dilate(np.where(known, log_depth, -_BEYOND), window)
    nearest = cv2.erode(np.where(known, log_depth, _BEYOND), window)
    return np.asarray(farthest - nearest, np.float32)
