"""The affine error of a depth cue: scale and shift of its disparity, as networks leave them open."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.robust import MAD_TO_SIGMA

_Depth = TypeVar("_Depth", FloatArray, Float32Array)

SHIFT_SIGMA = 0.08
"""Standard deviation of the shift, of the median inverse depth, before anything is seen."""
_ITERATIONS = 12
_SETTLED = 1e-4
"""Relative change of an affine error that is no change."""
_INDEPENDENT = 30
"""The smooth error makes samples alike: all of a frame say no more than this many on their own."""


class AffineError(NamedTuple):
    """What makes depth of a cue ``D``: ``1 / z = scale / D + shift``."""

    scale: float
    shift: float
    """1/m."""
    spread: float
    """Robust standard deviation of the log depth that is left; NaN where nothing was fitted."""

    def log_depth(self, cue: _Depth, least_inverse: float | _Depth) -> _Depth:
        """Return the log depth of a cue, m.

        Args:
            cue: (...) m.
            least_inverse: Inverse depth, 1/m, that is left at least.
        """
        log_inverse: _Depth = np.log(np.maximum(self.scale / cue + self.shift, least_inverse))
        return -log_inverse


def fit_affine(cue: FloatArray, log_depth: FloatArray, weight: FloatArray, shift_sigma: float = np.inf) -> AffineError:
    """Fit ``1 / z = a / cue + b`` robustly.

    A line that falls, or that makes depth of the samples negative, is replaced by a scale alone.

    Args:
        cue: (N,) m, positive.
        log_depth: (N,) of the same pixels.
        weight: (N,) not negative.
        shift_sigma: Standard deviation of the shift before anything is seen, of the median inverse depth.
    """
    inverse, wanted = 1.0 / cue, np.exp(-log_depth)
    median = partial(_weighted_median, weight=None if weight.min() == weight.max() > 0 else weight)
    scale = float(np.exp(-median(log_depth - np.log(cue))))
    typical, nearest, farthest = float(np.median(wanted)), float(inverse.min()), float(wanted.min())
    a, b = scale, 0.0
    # Relative residuals: an error of inverse depth counts by how deep it is.
    relative, mass = weight / wanted**2, float(weight.sum())
    left = -np.log(a * inverse) - log_depth
    for _ in range(_ITERATIONS):
        sigma = max(MAD_TO_SIGMA * median(np.abs(left)), 1e-4)
        w = relative / (1.0 + (left / (2.0 * sigma)) ** 2) ** 2
        # One more sample, of no inverse depth at none: without evidence there is no shift.
        least = (sigma / (shift_sigma * typical)) ** 2 * mass / _INDEPENDENT
        total = float(w.sum()) + least
        x, y = float(w @ inverse) / total, float(w @ wanted) / total
        away = inverse - x
        weighted = w * away
        spread = float(weighted @ away) + least * x**2
        slope = (float(weighted @ (wanted - y)) + least * x * y) / max(spread, 1e-12 * total)
        shift = y - slope * x
        if slope <= 0.2 * scale or slope > 5.0 * scale or slope * nearest + shift <= 0.1 * farthest:
            slope, shift = scale, 0.0
        done = abs(slope - a) + abs(shift - b) < _SETTLED * (abs(a) + abs(b))
        a, b = slope, shift
        left = -np.log(a * inverse + b) - log_depth
        if done:
            break
    return AffineError(a, b, MAD_TO_SIGMA * median(np.abs(left)))


def _weighted_median(values: FloatArray, weight: FloatArray | None) -> float:
    """Return the lower weighted median; without weights, all count alike."""
    if weight is None:
        middle = (len(values) - 1) // 2
        return float(np.partition(values, middle)[middle])
    order = np.argsort(values)
    mass = np.cumsum(weight[order])
    return float(values[order[min(int(np.searchsorted(mass, 0.5 * mass[-1])), len(values) - 1)]])
