"""What a still scene would be behind tracks that move.

Depth that is interpolated between points has some of what moves: tracks of it that agree with a still point for a while
(somebody who walks along with the camera). There a comparison of frames finds that a still point at that wrong
depth would look just so. Where most tracks move, the scene is taken from around them instead.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array


def depth_behind(depth: Float32Array, moving: BoolArray) -> Float32Array:
    """Return a depth map (h, w) whose marked pixels (h, w) continue what is around them, in inverse depth.

    Averages over blocks that double in size fill the marked pixels, each from the smallest block that knows any
    (Gortler, Grzeszczuk, Szeliski and Cohen, SIGGRAPH 1996: pull and push). Without a mark or with nothing else the
    depth is returned as it is.
    """
    known = ~moving & np.isfinite(depth) & (depth > 0)
    if not moving.any() or not known.any():
        return depth
    weight = known.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        sums = np.where(known, 1 / depth, 0).astype(np.float32)
    levels = [(sums, weight)]
    while max(sums.shape) > 1:
        size = tuple((side + 1) // 2 for side in sums.shape[::-1])
        sums, weight = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (sums, weight))
        levels.append((sums, weight))
    inverse = sums / weight
    for sums, weight in reversed(levels[:-1]):
        inverse = cv2.resize(inverse, sums.shape[::-1], interpolation=cv2.INTER_LINEAR)
        inverse = sums + (1 - weight) * inverse  # a block that is known in part is filled up from the next larger one
    return np.where(moving, 1 / inverse, depth).astype(np.float32)
