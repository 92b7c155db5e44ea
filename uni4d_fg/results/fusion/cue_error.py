r"""What is wrong with a depth cue, measured against depth that is known, and taken out of it.

A network's depth is wrong by scale and shift of its disparity, and by a smooth field on top,

    1 / z = (a / D + b) exp(-f(x)).

Both are fitted to depth from several views and to landmarks: (a, b) by reweighted least squares, f by averaging what is
left over Gaussian windows, wide ones first, each shrunk towards the one before where little is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, IntArray, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.wide_window import averaged, nodes, resized, sigma_on
from uni4d_fg.slam.stages.affine_error import SHIFT_SIGMA, AffineError, fit_affine

_MAX_SAMPLES = 4000
_MIN_SAMPLES = 12
_FARTHEST = 0.02
"""Least inverse depth, of the median one."""


@dataclass(frozen=True)
class KnownDepth:
    """Depth of one frame from elsewhere, at some pixels, at working size."""

    log_depth: Float32Array
    """(h, w), NaN where unknown."""
    weight: Float32Array
    """(h, w) not negative: 0 where unknown, about 1 where it is sure."""


@dataclass(frozen=True)
class CorrectedCue:
    """A cue without what was found wrong with it."""

    log_depth: Float32Array
    """(h, w), NaN where the cue is missing."""
    error: AffineError
    """(a, b)"""
    least_inverse: float
    """1/m: what is farther is bounded."""
    field: Float32Array
    """(h, w) f, with the opposite sign."""

    def affine(self, cue: Float32Array) -> Float32Array:
        """Return the log depth of a cue, m, without its affine error alone; of any pixels of the same frame."""
        return self.error.log_depth(cue, self.least_inverse)


def correct_cue(cue: Float32Array, known: KnownDepth, default_log_scale: float, config: FusionConfig) -> CorrectedCue:
    """Take affine and smooth errors out of a cue.

    Args:
        cue: (h, w) m, NaN where missing.
        known: What is known besides.
        default_log_scale: Of the frame, where next to nothing is known.
        config: Windows.
    """
    usable = np.isfinite(cue) & (known.weight > 0) & np.isfinite(known.log_depth)
    rows, columns = np.nonzero(usable)
    if len(rows) < _MIN_SAMPLES:
        error = AffineError(float(np.exp(-default_log_scale)), 0.0, np.nan)
        log_depth = np.log(cue) + np.float32(default_log_scale)
        return CorrectedCue(log_depth, error, _least_inverse(cue, error), np.zeros_like(cue))
    some = evenly_spread(len(rows), _MAX_SAMPLES)
    at = rows[some], columns[some]
    error = fit_affine(
        cue[at].astype(np.float64),
        known.log_depth[at].astype(np.float64),
        known.weight[at].astype(np.float64),
        SHIFT_SIGMA,
    )
    least = _least_inverse(cue, error)
    log_depth = error.log_depth(cue, least)
    residual = np.where(usable, known.log_depth - log_depth, np.float32(0))
    weight = np.where(usable & (np.abs(residual) < 4.0 * error.spread + 0.02), known.weight, np.float32(0))
    field = smooth_field(residual, weight, config)
    return CorrectedCue(log_depth + field, error, least, field)


def _least_inverse(cue: Float32Array, error: AffineError) -> float:
    """Return the inverse depth below which an affinely corrected cue is taken to be beyond all bounds, 1/m."""
    known = np.flatnonzero(np.isfinite(cue))
    if not known.size:
        return 0.0
    some = cue.ravel()[known[evenly_spread(known.size, _MAX_SAMPLES)]]
    return _FARTHEST * float(np.median(error.scale / some + error.shift))


def smooth_field(residual: Float32Array, weight: Float32Array, config: FusionConfig) -> Float32Array:
    """Average what is left over Gaussian windows, wide ones first, (h, w).

    Args:
        residual: (h, w) of log depth; any finite value where the weight is 0.
        weight: (h, w) not negative.
        config: Windows, and the strength of the wider window where little is known.
    """
    size = nodes(min(config.field_windows) * residual.shape[1], residual.shape)
    mass, pull = (averaged(values, size) for values in (weight, weight * residual))
    return _field(mass, pull, residual.shape, config)


def smooth_field_of_points(
    at: tuple[IntArray, IntArray], residual: FloatArray, weight: float, shape: tuple[int, int], config: FusionConfig
) -> Float32Array:
    """Return what :func:`smooth_field` does, (h, w), where all but some points have no weight.

    Args:
        at: Row and column (N,) of each point; several may share a pixel.
        residual: (N,) of log depth.
        weight: Of each point.
        shape: (h, w).
        config: As there.
    """
    rows, columns = nodes(min(config.field_windows) * shape[1], shape)
    node = (at[0] * rows // shape[0]) * columns + at[1] * columns // shape[1]
    share = weight * (rows * columns) / (shape[0] * shape[1])
    mass, pull = (
        (share * np.bincount(node, values, minlength=rows * columns)).reshape(rows, columns).astype(np.float32)
        for values in (None, residual)
    )
    return _field(mass, pull, shape, config)


def _field(mass: Float32Array, pull: Float32Array, shape: tuple[int, ...], config: FusionConfig) -> Float32Array:
    """Return the field (h, w) from weights and weighted residuals on the finest grid.

    Each window is taken on a grid that is coarse beside it, as the mean over a window is smooth.
    """
    grids = []
    for sigma in sorted(share * shape[1] for share in config.field_windows):
        mass, pull = (averaged(values, nodes(sigma, shape)) for values in (mass, pull))
        grids.append((sigma_on(mass.shape, sigma, shape), mass, pull))
    field = np.zeros((1, 1), np.float32)
    for on_grid, mass, pull in reversed(grids):
        field = resized(field, mass.shape)
        around = cv2.GaussianBlur(np.dstack((mass, pull - mass * field)), (0, 0), on_grid)
        field = field + around[..., 1] / (around[..., 0] + np.float32(config.field_prior))
    return resized(field, shape)
