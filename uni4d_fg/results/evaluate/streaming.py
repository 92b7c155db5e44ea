"""Medians and disparity fits over a video that is never held in memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray

_HALF_RANGE = 12.0
_BIN_WIDTH = 1e-5
_NUM_BINS = 2 * int(_HALF_RANGE / _BIN_WIDTH)


@dataclass
class StreamingLogMedian:
    """Median of positive numbers by a fine histogram of their logarithms.

    The result is exact to a relative 1e-5; values outside exp(-12) to exp(12) count at the ends.
    """

    counts: IntArray = field(default_factory=lambda: np.zeros(_NUM_BINS, dtype=np.int64))

    def add(self, log_values: npt.NDArray[np.floating]) -> None:
        """Add natural logarithms, any shape, all finite."""
        if log_values.size == 0:
            return
        bins = np.floor((log_values.ravel() + _HALF_RANGE) / _BIN_WIDTH)
        self.counts += np.bincount(np.clip(bins, 0, _NUM_BINS - 1).astype(np.int64), minlength=_NUM_BINS)

    def median(self) -> float | None:
        """Return the median of the numbers themselves (not their logarithms); None without any."""
        cumulative = np.cumsum(self.counts)
        total = int(cumulative[-1])
        if total == 0:
            return None
        below = np.searchsorted(cumulative, [(total - 1) // 2, total // 2], side="right")
        centers = np.exp((below + 0.5) * _BIN_WIDTH - _HALF_RANGE)
        return float(centers.mean())


@dataclass
class StreamingLine:
    """Least-squares line ``y = scale x + shift``, from running sums of deviations from the means."""

    count: int = 0
    mean_x: float = 0.0
    mean_y: float = 0.0
    variation_x: float = 0.0
    covariation: float = 0.0

    def add(self, x: FloatArray, y: FloatArray) -> None:
        """Add pairs (N,)."""
        if x.size == 0:
            return
        mean_x, mean_y, new = float(x.mean()), float(y.mean()), self.count + x.size
        step_x, step_y = mean_x - self.mean_x, mean_y - self.mean_y
        weight = self.count * x.size / new
        self.variation_x += float(((x - mean_x) ** 2).sum()) + step_x**2 * weight
        self.covariation += float(((x - mean_x) * (y - mean_y)).sum()) + step_x * step_y * weight
        self.mean_x += step_x * x.size / new
        self.mean_y += step_y * x.size / new
        self.count = new

    def fit(self) -> tuple[float, float] | None:
        """Return (scale, shift); the shift is 0 where all x are equal. None without any pair."""
        if self.count == 0:
            return None
        if self.variation_x <= 1e-20 * self.count * self.mean_x**2:
            return (self.mean_y / self.mean_x if self.mean_x else 1.0), 0.0
        scale = self.covariation / self.variation_x
        return scale, self.mean_y - scale * self.mean_x
