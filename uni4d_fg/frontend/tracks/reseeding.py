"""New query points for the parts of an image in which no live point is left."""

from __future__ import annotations

import math

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.cues import TrackingConfig


def corners_of_empty_cells(image: ImageArray, points: Float32Array, config: TrackingConfig) -> Float32Array:
    """Return one new query point for each cell of an image that holds no point, where there is texture.

    Cells are squares of ``reseed_spacing`` times the spacing of the grid. The point is the pixel at which the
    smaller eigenvalue of the gradient matrix is largest (Shi and Tomasi, "Good features to track", 1994); a cell
    whose best falls short of ``reseed_quality`` times the image's best stays empty.

    Args:
        image: (H, W) uint8, gray.
        points: (N, 2) live points, px.
        config: The grid, ``reseed_spacing`` (None gives no points), ``reseed_quality`` and ``margin_px``.

    Returns:
        (M, 2) px.
    """
    if config.reseed_spacing is None:
        return np.zeros((0, 2), np.float32)
    height, width = image.shape
    spacing = max(height / config.grid_rows, width / config.grid_columns)
    side = max(1, round(config.reseed_spacing * spacing))
    rows, columns = math.ceil(height / side), math.ceil(width / side)
    empty = np.ones((rows, columns), np.bool_)
    cell = np.floor((points + 0.5) / side).astype(np.int64)
    empty[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)] = False
    if not empty.any():
        return np.zeros((0, 2), np.float32)

    corner = cv2.cornerMinEigenVal(image, blockSize=5, ksize=3)
    least = config.reseed_quality * float(corner.max())
    margin = math.ceil(config.margin_px)
    inner = np.zeros((rows * side, columns * side), np.float32)
    inside = slice(margin, max(height - margin, margin)), slice(margin, max(width - margin, margin))
    inner[inside] = corner[inside]
    row, column = np.nonzero(empty)
    cells = inner.reshape(rows, side, columns, side)[row, :, column].reshape(-1, side * side)
    best = cells.argmax(axis=1)
    found = np.stack((column * side + best % side, row * side + best // side), axis=1).astype(np.float32)
    result: Float32Array = found[cells[np.arange(len(cells)), best] > least]
    return result
