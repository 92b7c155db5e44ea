"""Noise measured from residuals, so that the MAP estimate's sigmas are not tuned."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.robust import robust_sigma


def intraclass_correlation(residuals: FloatArray, group: IntArray) -> float:
    """Return how alike the residuals of one group are: 0 for independent ones, 1 for one constant per group.

    The one-way analysis of variance (Fisher 1925) on residuals clipped at three robust sigmas.

    Args:
        residuals: (N,) residuals.
        group: (N,) group of each, 0 .. G - 1.
    """
    limit = 3.0 * robust_sigma(residuals)
    if len(residuals) < 2 or not limit > 0:
        return 0.0
    values = np.clip(residuals, -limit, limit)
    count = np.bincount(group).astype(np.float64)
    mean = np.bincount(group, values) / np.maximum(count, 1.0)
    groups, total = int((count > 0).sum()), len(values)
    if groups < 2 or total <= groups:
        return 0.0
    within = float(np.sum((values - mean[group]) ** 2)) / (total - groups)
    between = float(np.sum(count * (mean - values.mean()) ** 2)) / (groups - 1)
    size = (total - float(np.sum(count**2)) / total) / (groups - 1)
    variance = max((between - within) / size, 0.0)
    return variance / max(variance + within, 1e-300)
