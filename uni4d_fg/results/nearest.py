"""Filling the holes of a map from the nearest pixels that are known."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, IntArray


def nearest_known(known: BoolArray) -> IntArray:
    """Return of each pixel the nearest one that is known, as its number in the map, (h, w).

    Args:
        known: (h, w), somewhere true.
    """
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    number_of: IntArray = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    number_of[labels[known]] = np.flatnonzero(known)
    return np.asarray(number_of[labels])


def from_nearest(values: Float32Array, known: BoolArray) -> Float32Array:
    """Return a map (h, w) in which every pixel that is not known has the value of the nearest one that is.

    Nothing is averaged: between two surfaces there is no third one. Without any that is known, it is as given.

    Args:
        values: (h, w).
        known: (h, w).
    """
    if known.all() or not known.any():
        return values
    return np.asarray(values.ravel()[nearest_known(known)], dtype=np.float32)
