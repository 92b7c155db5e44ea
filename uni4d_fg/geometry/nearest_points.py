"""The nearest of many points, by OpenCV.

scipy's tree finds the same in twice the time; and to load it takes a third of a second, for which the viewer's first
picture would wait.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array

_KD_TREE = {"algorithm": 4, "leaf_max_size": 10}
"""FLANN's KDTREE_INDEX_SINGLE, which is for few dimensions and, searched to the end, exact."""
_TO_THE_END = {"checks": -1}


class NearestPoints:
    """Points among which the nearest are found, exactly and in single precision.

    Args:
        points: (N, D) in any unit, finite; D is 2 or 3.
    """

    def __init__(self, points: FloatArray | Float32Array) -> None:
        self._count = len(points)
        self._tree = cv2.flann.Index(np.ascontiguousarray(points, np.float32), _KD_TREE)

    def find(self, places: FloatArray | Float32Array, count: int) -> tuple[Float32Array, Int32Array]:
        """Return the distances and rows of the nearest points, nearest first, each (M, count).

        Args:
            places: (M, D) in the same unit, finite.
            count: Points that are asked for, at most N.

        Raises:
            ValueError: If there are fewer points.
        """
        if self._count < count:
            raise ValueError(f"{count} of {self._count} points are asked for")
        if not len(places):  # which OpenCV refuses
            return np.zeros((0, count), np.float32), np.zeros((0, count), np.int32)
        rows, squared = self._tree.knnSearch(np.ascontiguousarray(places, np.float32), count, params=_TO_THE_END)
        return np.sqrt(squared), rows
