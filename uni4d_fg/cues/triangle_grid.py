"""Values of scattered points on a grid, linear over the triangles between them.

Every triangle fills the nodes of the grid that it covers, row by row: a row cuts it from one of its sides to another.
SciPy's interpolator gives the same and takes five times as long, as it inverts a matrix for every triangle.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError

from uni4d_fg.arrays import FloatArray, IntArray

_MARGIN = 1e-9
"""Nodes this far outside of a triangle, in parts of the grid's spacing, are on its side: none falls between two."""
_FLAT = 1e-9
"""Twice the area below which a triangle is a line."""


def linear_on_grid(places: FloatArray, values: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Interpolate values over the Delaunay triangles of their places.

    Args:
        places: (N, 2) columns and rows of the points, in nodes of the grid.
        values: (N,).
        shape: Rows and columns of the grid.

    Returns:
        (rows, columns); NaN outside of the points' hull, and everywhere for fewer than three points or those
        on one line.
    """
    out = np.full(shape, np.nan)
    try:
        triangles = Delaunay(places).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        return out
    x, y, z = places[triangles, 0].T, places[triangles, 1].T, values[triangles].T
    across = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    first = np.maximum(np.ceil(y.min(axis=0) - _MARGIN), 0).astype(np.int64)
    last = np.minimum(np.floor(y.max(axis=0) + _MARGIN), shape[0] - 1).astype(np.int64)
    kept = (last >= first) & (np.abs(across) > _FLAT)
    x, y, z, across, first, last = x[:, kept], y[:, kept], z[:, kept], across[kept], first[kept], last[kept]
    triangle, row = _ranges(first, last)
    left, right = _cuts(x, y, triangle, row)
    begin = np.maximum(np.ceil(left - _MARGIN), 0).astype(np.int64)
    end = np.minimum(np.floor(right + _MARGIN), shape[1] - 1).astype(np.int64)
    cut, column = _ranges(begin, end)
    triangle, row = triangle[cut], row[cut]
    # The plane through the three corners; rounding does not lead beyond them, however thin the triangle.
    by_x = ((z[1] - z[0]) * (y[2] - y[0]) - (z[2] - z[0]) * (y[1] - y[0])) / across
    by_y = ((z[2] - z[0]) * (x[1] - x[0]) - (z[1] - z[0]) * (x[2] - x[0])) / across
    value = z[0][triangle] + by_x[triangle] * (column - x[0][triangle]) + by_y[triangle] * (row - y[0][triangle])
    out[row, column] = np.clip(value, z.min(axis=0)[triangle], z.max(axis=0)[triangle])
    return out


def _ranges(first: IntArray, last: IntArray) -> tuple[IntArray, IntArray]:
    """Return the numbers from ``first`` (n,) to ``last`` (n,), one range after the other, and the range of each."""
    count = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
    return owner, first[owner] + within


def _cuts(x: FloatArray, y: FloatArray, triangle: IntArray, row: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return where rows (n,) enter and leave triangles with corners (3, m), columns (n,) each."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        rise = y[b] - y[a]
        with np.errstate(divide="ignore", invalid="ignore"):
            part = (row - y[a][triangle]) / rise[triangle]
        # A side along the row is cut at its ends, by the others.
        meets = (part >= -_MARGIN) & (part <= 1 + _MARGIN)
        at = np.where(meets, x[a][triangle] + part * (x[b] - x[a])[triangle], np.nan)
        left, right = np.fmin(left, at), np.fmax(right, at)
    return left, right
