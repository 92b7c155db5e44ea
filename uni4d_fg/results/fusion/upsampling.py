"""Depth brought to the size of the image, with the image's edges: joint bilateral upsampling.

Each pixel takes a mean over the working pixels around it, weighted by how near they are and by how much their color is
like its own (Kopf et al. 2007, "Joint bilateral upsampling").
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray

_SPATIAL = 0.7
"""Standard deviation of the weights by distance, working px."""
_COLOR = 0.05
"""And of those by color, of 1."""


def upsample_guided(values: Float32Array, image: ImageArray) -> Float32Array:
    """Return a map (h, w) at the size of an image, (H, W); NaN where all around is.

    Args:
        values: (h, w), NaN where missing.
        image: (H, W, 3) RGB, not smaller.
    """
    (h, w), (height, width) = values.shape, image.shape[:2]
    guide = image.astype(np.float32) / np.float32(255.0)
    coarse = cv2.resize(guide, (w, h), interpolation=cv2.INTER_AREA)
    u = (np.arange(width, dtype=np.float32) + 0.5) * np.float32(w / width) - 0.5
    v = (np.arange(height, dtype=np.float32) + 0.5) * np.float32(h / height) - 0.5
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    total, weights = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            i, j = np.clip(row + dv, 0, h - 1), np.clip(column + du, 0, w - 1)
            near = np.exp(-0.5 * ((i - v) / _SPATIAL) ** 2)[:, None] * np.exp(-0.5 * ((j - u) / _SPATIAL) ** 2)[None]
            at = np.ix_(i, j)
            alike = ((guide - coarse[at]) ** 2).sum(axis=2) / np.float32(2 * _COLOR**2)
            sample = values[at]
            known = np.isfinite(sample)
            weight = np.where(known, near * np.exp(-np.minimum(alike, 60)) + np.float32(1e-12), 0).astype(np.float32)
            total += weight * np.where(known, sample, np.float32(0))
            weights += weight
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / weights, dtype=np.float32)
