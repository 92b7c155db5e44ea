"""The nearest of many points in space, by OpenCV: for programs that answer at once.

scipy's tree finds the same, but to load it takes a third of a second, for which the viewer's first picture would wait.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array

_KD_TREE = {"algorithm": 4, "leaf_max_size": 10}
"""FLANN's KDTREE_INDEX_SINGLE, which is for few dimensions and, searched to the end, exact."""
_TO_THE_END = {"checks": -1}


def nearest_points(
    points: FloatArray | Float32Array, places: FloatArray | Float32Array, count: int
) -> tuple[Float32Array, Int32Array]:
    """Return the distances and rows of the nearest points, nearest first, each (M, count); in single precision.

    Args:
        points: (N, 3) in any unit, finite; N at least ``count``.
        places: (M, 3) in the same unit, finite; M at least 1.
        count: Points that are asked for.

    Raises:
        ValueError: If there are fewer points.
    """
    if len(points) < count:
        raise ValueError(f"{count} of {len(points)} points are asked for")
    tree = cv2.flann.Index(np.ascontiguousarray(points, np.float32), _KD_TREE)
    rows, squared = tree.knnSearch(np.ascontiguousarray(places, np.float32), count, params=_TO_THE_END)
    return np.sqrt(squared), rows
