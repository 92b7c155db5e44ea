"""What another image shows of pixels on a plane of inverse depth, as the C++ extension samples it."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array


def warp(
    other: Float32Array,
    turn: Float32Array,
    shift: Float32Array,
    u: Float32Array,
    v: Float32Array,
    rho: Float32Array | np.float32,
) -> tuple[Float32Array, BoolArray]:
    """Return the gray values that another image has of pixels, and where they are known; 0 elsewhere.

    Args:
        other: (h, w), NaN where it is not to be matched.
        turn: (3, 3) and
        shift: (3,): pixel x at inverse depth rho is seen at ``turn x + rho shift``.
        u: Columns of the pixels and
        v: their rows, any shape.
        rho: Their inverse depth, 1/m, of a shape that broadcasts to theirs.
    """
    height, width = other.shape
    a, b, c = (turn[i, 0] * u + (turn[i, 1] * v + turn[i, 2] + rho * shift[i]) for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = a / c, b / c
        inside = (c > 0) & (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    i, j = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    p, q = x - i.astype(np.float32), y - j.astype(np.float32)
    top = other[j, i] * (1 - p) + other[j, i + 1] * p
    low = other[j + 1, i] * (1 - p) + other[j + 1, i + 1] * p
    value = top * (1 - q) + low * q
    known = inside & np.isfinite(value)
    return np.where(known, value, np.float32(0)), known
