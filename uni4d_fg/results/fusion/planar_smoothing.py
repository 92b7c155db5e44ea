r"""Depth where nothing is sure, made smooth from what is sure around it: second-order total variation.

Where surfaces have no texture, matches and interpolated depth are spotted, and each spot is as likely as the next.
Most such surfaces are plain, and the inverse depth of a plane is linear in the image. On a grid of some 80 nodes, x
minimizes

    sum_i  w_i rho(x_i / m_i - 1)  +  lambda  sum_k  g_k |(D x)_k| / m_k,

where m is the inverse depth that was found, w the square of its probability, rho a robust norm, and D the second
differences along rows, down columns and across both (the Hessian). Its norm is not squared: surfaces may bend, at few
places (Bredies et al. 2010, "Total generalized variation"). g falls with edges of the image and of the depth that was
found (Ferstl et al. 2013 guide the total variation of a depth map by an image). Both terms are relative to m: the small
inverse depth of what is far must not be carried away by what is near.

Iteratively reweighted least squares solves it: each step is one banded system, twice as wide as the shorter side.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.linalg import solveh_banded

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.results.fusion.log_range import log_range

_NODES = 80
"""Along the longer side."""
_STEPS = 2
_STRENGTH = 0.1
"""lambda"""
_BENT = 0.01
"""Relative second difference up to which the norm is a square, and ..."""
_WRONG = 0.1
"""... relative departure from which on depth that was found counts less."""
_CONTRAST = 0.05
"""Difference of colors, of 1, that halves the weight of a link between neighbors, and ..."""
_STEP = 0.05
"""... the difference of log depth."""
_LEAST_WEIGHT, _MISSING_WEIGHT = 1e-4, 1e-7
_NEAREST = 0.02
"""Least inverse depth, of the median one, that errors are relative to."""
_UNSURE, _SURE = 0.3, 0.7
"""With less probability depth is replaced, with more it is kept, and mixed in between ..."""
_EDGE, _WHOLE_EDGE = 0.1, 0.2
"""... and so it is with the range of log depth around a pixel: edges are kept where they are."""
_AROUND = np.ones((5, 5), np.uint8)


def smoothed_where_unsure(log_depth: Float32Array, sure: Float32Array, color: Float32Array) -> Float32Array:
    """Return log depth (h, w) in which what is unsure continues what is sure, as planes if nothing speaks against it.

    Args:
        log_depth: (h, w), NaN where missing: it stays so.
        sure: (h, w) probability that it is right; 0 where it says nothing, as where something moves.
        color: (h, w, 3) RGB, of 1.
    """
    if not np.isfinite(log_depth).any():
        return log_depth
    keep = np.clip((sure - _UNSURE) / (_SURE - _UNSURE), 0, 1)
    edge = np.clip((log_range(log_depth, _AROUND) - _EDGE) / (_WHOLE_EDGE - _EDGE), 0, 1)
    keep = np.maximum(keep, edge)
    height, width = log_depth.shape
    stride = max(1, round(max(height, width) / _NODES))
    size = -(-width // stride), -(-height // stride)
    known = np.isfinite(log_depth)
    middle = np.float32(np.median(np.exp(-log_depth[known])))
    inverse = np.where(known, np.exp(-log_depth), middle)
    weight = np.where(known, sure.astype(np.float64) ** 2 + _LEAST_WEIGHT, _MISSING_WEIGHT)
    total = _shrunk(weight, size)
    coarse = _shrunk(weight * inverse, size) / total / float(middle)
    found = _minimized(coarse, total, _shrunk(color, size))
    smooth = middle * np.asarray(cv2.resize(found, (width, height)), np.float32)
    smooth = np.clip(smooth, inverse.min(), inverse.max())
    mixed = -np.log(keep * inverse + (1 - keep) * smooth)
    return np.asarray(np.where(known & (keep < 1), mixed, log_depth), np.float32)


def _shrunk(values: FloatArray | Float32Array, size: tuple[int, int]) -> FloatArray:
    small: FloatArray = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float64)
    return small


def _minimized(inverse: FloatArray, weight: FloatArray, color: FloatArray) -> FloatArray:
    """Return the minimum (h, w).

    Args:
        inverse: (h, w) inverse depth m, about 1.
        weight: (h, w) positive.
        color: (h, w, 3), of 1.
    """
    if inverse.shape[0] > inverse.shape[1]:  # unknowns are counted down columns, which are to be the shorter side
        return _minimized(inverse.T, weight.T, color.transpose(1, 0, 2)).T
    scale = np.maximum(inverse, _NEAREST)
    links = _links(np.log(scale), color)
    # With how strong a second difference is at first, before it is known how large it is.
    bent = tuple(_STRENGTH * link / (4 * _BENT) / at**2 for link, at in zip(links, _middles(scale), strict=True))
    held, x = weight / scale**2, inverse
    for step in range(_STEPS):
        if step:
            bent = tuple(
                _STRENGTH * link / np.hypot(second / at, _BENT) / at**2
                for link, second, at in zip(links, _second_differences(x), _middles(scale), strict=True)
            )
            held = weight / scale**2 / np.hypot(1, (x - inverse) / scale / _WRONG)
        x = _solved(held, held * inverse, *bent)
    return x


def _links(log_inverse: FloatArray, color: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how much second differences down columns, along rows and across both count: products of their links'."""

    def link(axis: int) -> FloatArray:
        contrast = np.abs(np.diff(color, axis=axis)).max(axis=2) / _CONTRAST
        step = np.diff(log_inverse, axis=axis) / _STEP
        weight: FloatArray = 1 / (1 + contrast**2) / (1 + step**2)
        return weight

    down, along = link(0), link(1)
    # The mixed difference is twice in the squared norm of the Hessian.
    mixed = 2 * along[:-1] * along[1:] * down[:, :-1] * down[:, 1:]
    return down[:-1] * down[1:], along[:, :-1] * along[:, 1:], mixed


def _middles(values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a map where second differences are taken: down columns, along rows and across both."""
    return values[1:-1], values[:, 1:-1], values[1:, 1:]


def _second_differences(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return (
        x[:-2] - 2 * x[1:-1] + x[2:],
        x[:, :-2] - 2 * x[:, 1:-1] + x[:, 2:],
        x[:-1, :-1] - x[:-1, 1:] - x[1:, :-1] + x[1:, 1:],
    )


def _solved(held: FloatArray, right: FloatArray, down: FloatArray, along: FloatArray, mixed: FloatArray) -> FloatArray:
    """Solve the normal equations of weighted second differences, (h, w).

    Node (i, j) is unknown number j h + i. Band d holds the entries between each unknown and the one d
    after it, so that a product of two nodes of a difference goes to the band of their distance, at the first of them.

    Args:
        held: (h, w) weights of the nodes.
        right: (h, w) right-hand side.
        down: (h - 2, w) weights of the differences 1, -2, 1 down columns.
        along: (h, w - 2) and along rows.
        mixed: (h - 1, w - 1) weights of 1, -1, -1, 1 on four neighbors.
    """
    height, width = held.shape
    bands = np.zeros((width, height, 2 * height + 1))  # LAPACK reads down its columns, which saves a copy

    def at(distance: int) -> FloatArray:
        band: FloatArray = bands[..., distance].T
        return band

    main = at(0)
    main += held
    for rows, factor in ((slice(0, -2), 1), (slice(1, -1), 4), (slice(2, None), 1)):
        main[rows] += factor * down
        main[:, rows] += factor * along
    for rows in (slice(0, -1), slice(1, None)):
        for columns in (slice(0, -1), slice(1, None)):
            main[rows, columns] += mixed
    at(1)[:-2] -= 2 * down
    at(1)[1:-1] -= 2 * down
    at(2)[:-2] += down
    at(1)[:-1, :-1] -= mixed
    at(1)[:-1, 1:] -= mixed
    at(height)[:, :-2] -= 2 * along
    at(height)[:, 1:-1] -= 2 * along
    at(2 * height)[:, :-2] += along
    at(height)[:-1, :-1] -= mixed
    at(height)[1:, :-1] -= mixed
    at(height + 1)[:-1, :-1] += mixed
    at(height - 1)[1:, :-1] += mixed
    flat = bands.reshape(width * height, -1).T
    x = solveh_banded(flat, right.T.ravel(), lower=True, overwrite_ab=True, check_finite=False)
    solved: FloatArray = x.reshape(width, height).T
    return solved
