"""Edges of swept depth, looked at again: ``cpp_factors/src/depth_edges.cpp`` in NumPy, what it must give.

A window that lies across an edge of depth has the texture of what is near and that of what is far, and the stronger one
decides for both; aggregation carries it on. Near an edge, each pixel therefore chooses again among the depths around
it, by differences of gray values over every second pixel of a window, in which they count by how much they are like
the middle one, as those of one surface mostly are (Yoon and Kweon 2006, "Adaptive support-weight approach for
correspondence search").
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.results.fusion.multiview.warp_numpy import warp

_AROUND = np.ones((9, 9), np.uint8)
_EDGE = np.float32(0.1)
"""Range of log depth within that window from which on a pixel is near an edge."""
_REACHES = (2, 4, 7)
"""Depths are tried of the pixels so far to the left and right, above and below, px."""
_ALIKE = np.float32(0.02)
"""Log depths that differ by less are one."""
_RADIUS = 2
_LIKE = np.float32(0.08)
"""Standard deviation of the weights by difference of gray values, of 1."""
_LARGEST = np.float32(0.15)
"""Larger differences are all alike."""
_SHOWN = np.float32(0.5)
"""A view that shows less than this part of a window says nothing of it, and a depth is tried where two views do."""
_BETTER = np.float32(0.002)
"""Another depth than a pixel's own is better by this at least."""


class _Windows(NamedTuple):
    """The pixels around some, (N, T) each."""

    u: Float32Array
    v: Float32Array
    gray: Float32Array
    weight: Float32Array
    """They sum to 1."""

    def of(self, some: IntArray) -> _Windows:
        return _Windows(*(part[some] for part in self))


def edges_again_numpy(
    inverse_depth: Float32Array,
    image: Float32Array,
    chosen: BoolArray,
    others: Float32Array,
    turns: FloatArray,
    shifts: FloatArray,
) -> Float32Array:
    """Return inverse depth (h, w) in which pixels near edges have the best of the depths around them.

    Args:
        inverse_depth: (h, w) 1/m, positive.
        image: (h, w), NaN where it is not to be matched: such pixels keep theirs, and so do those that too few views
            show.
        chosen: (h, w) where pixels may change.
        others: (V, h, w) alike.
        turns: (V, 3, 3) and
        shifts: (V, 3): pixel x at inverse depth rho is seen at ``turns x + rho shifts``.
    """
    least, most = cv2.erode(inverse_depth, _AROUND), cv2.dilate(inverse_depth, _AROUND)
    near_edge = chosen & (most > least * np.exp(_EDGE)) & np.isfinite(image)
    row, column = np.nonzero(near_edge)
    if not len(row):
        return inverse_depth
    tried = [inverse_depth[row, column]]
    out, alike = tried[0].copy(), np.exp(_ALIKE)
    window = _window(image, row, column)
    cost = _cost(out, window, others, turns, shifts) - _BETTER
    cost[np.isinf(cost)] = -np.inf
    for reach in _REACHES:
        for dy, dx in ((0, -reach), (0, reach), (-reach, 0), (reach, 0)):
            v, u = row + dy, column + dx
            inside = (v >= 0) & (u >= 0) & (v < image.shape[0]) & (u < image.shape[1])
            other = np.where(inside, inverse_depth[np.where(inside, v, 0), np.where(inside, u, 0)], np.float32(np.nan))
            new = inside & ~np.any([(other < one * alike) & (one < other * alike) for one in tried], axis=0)
            tried.append(np.where(new, other, np.float32(np.nan)))
            at = np.flatnonzero(new)
            found = _cost(other[at], window.of(at), others, turns, shifts)
            better = found < cost[at]
            cost[at[better]], out[at[better]] = found[better], other[at[better]]
    again = inverse_depth.copy()
    again[row, column] = out
    return again


def _window(image: Float32Array, row: IntArray, column: IntArray) -> _Windows:
    # Every second pixel, as on a chessboard.
    dy, dx = (part.ravel()[::2] for part in np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1])
    v, u = row[:, None] + dy, column[:, None] + dx
    inside = (v >= 0) & (u >= 0) & (v < image.shape[0]) & (u < image.shape[1])
    gray = image[np.where(inside, v, 0), np.where(inside, u, 0)]
    known = inside & np.isfinite(gray)
    gray = np.where(known, gray, np.float32(0))
    unlike = (gray - image[row, column][:, None]) / _LIKE
    weight = np.where(known, np.exp(np.float32(-0.5) * unlike * unlike), np.float32(0))
    weight = weight / weight.sum(axis=1, keepdims=True)
    return _Windows(u.astype(np.float32), v.astype(np.float32), gray, weight)


def _cost(
    inverse_depth: Float32Array, window: _Windows, others: Float32Array, turns: FloatArray, shifts: FloatArray
) -> Float32Array:
    """Return how unlike windows are (N,), each on a plane of one inverse depth: the mean of the two best views.

    It is infinite where fewer than two views show enough of a window; one, if there is but one.
    """
    u, v, gray, weight = window
    rho, found = inverse_depth[:, None], []
    for other, turn, shift in zip(others, turns.astype(np.float32), shifts.astype(np.float32), strict=True):
        value, known = warp(other, turn, shift, u, v, rho)
        share = np.where(known, weight, np.float32(0))
        total = share.sum(axis=1)
        unlike = share * np.minimum(np.abs(value - gray), _LARGEST)
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.where(total >= _SHOWN, unlike.sum(axis=1) / total, np.float32(np.inf)))
    ordered = np.sort(np.stack(found), axis=0)
    return np.asarray((ordered[0] + ordered[1]) / 2 if len(found) > 1 else ordered[0], np.float32)
