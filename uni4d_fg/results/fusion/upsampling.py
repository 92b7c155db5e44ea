"""Depth brought to the size of the image, with the image's edges: joint bilateral upsampling.

Each pixel takes a mean over the working pixels around it, weighted by how near they are and by how much their color is
like its own (Kopf et al. 2007, "Joint bilateral upsampling").
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.optim.extension import find_extension

_SPATIAL = 0.7
"""Standard deviation of the weights by distance, working px."""
_COLOR = 0.05
"""And of those by color, of 1."""


def upsample_guided(values: Float32Array, image: ImageArray, threads: int = 1) -> Float32Array:
    """Return a map (h, w) at the size of an image, (H, W); NaN where all around is.

    Args:
        values: (h, w), NaN where missing.
        image: (H, W, 3) RGB, not smaller.
        threads: Of the C++ version; 0 takes all cores.
    """
    size = values.shape[1], values.shape[0]
    colors = np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    core, _ = find_extension()
    if core is None:
        return upsample_guided_numpy(values, colors, image, _SPATIAL, 255 * _COLOR)
    upsampled: Float32Array = core.upsample_guided(
        values, colors, np.ascontiguousarray(image), spatial=_SPATIAL, color=255 * _COLOR, threads=threads
    )
    return upsampled


def upsample_guided_numpy(
    values: Float32Array, colors: Float32Array, image: ImageArray, spatial: float, color: float
) -> Float32Array:
    """Do what ``cpp_factors/src/guided_upsampling.cpp`` does.

    Args:
        values: (h, w), NaN where missing.
        colors: (h, w, 3) the image at this size, of 255.
        image: (H, W, 3) RGB.
        spatial: Standard deviation of the weights by distance, pixels of the map ...
        color: ... and of those by color, of 255.
    """
    (h, w), (height, width) = values.shape, image.shape[:2]
    guide = image.astype(np.float32)
    u = (np.arange(width, dtype=np.float32) + 0.5) * np.float32(w / width) - 0.5
    v = (np.arange(height, dtype=np.float32) + 0.5) * np.float32(h / height) - 0.5
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    total, weights = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            i, j = np.clip(row + dv, 0, h - 1), np.clip(column + du, 0, w - 1)
            near = np.exp(-0.5 * ((i - v) / spatial) ** 2)[:, None] * np.exp(-0.5 * ((j - u) / spatial) ** 2)[None]
            at = np.ix_(i, j)
            unlike = ((guide - colors[at]) ** 2).sum(axis=2) / np.float32(2 * color**2)
            sample = values[at]
            known = np.isfinite(sample)
            weight = np.where(known, near * np.exp(-np.minimum(unlike, 60)) + np.float32(1e-12), 0).astype(np.float32)
            total += weight * np.where(known, sample, np.float32(0))
            weights += weight
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / weights, dtype=np.float32)
