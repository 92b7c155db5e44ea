"""Noise measured from residuals, so that the MAP estimate's sigmas are not tuned."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray

_MAD_TO_SIGMA = 1.4826


def robust_sigma(residuals: FloatArray) -> float:
    """Return the standard deviation of a normal with the residuals' median absolute deviation about zero.

    Args:
        residuals: Any shape; components count one by one. NaN for an empty array.
    """
    if residuals.size == 0:
        return float("nan")
    return float(_MAD_TO_SIGMA * np.median(np.abs(residuals)))
