"""The spread of numbers of which some are far off."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

WITHIN_95 = 1.96
"""So many standard deviations to either side hold 95 % of a normal distribution."""
MEDIAN_OF_NORM = 1.1774
"""The median length of a plane vector whose two components are normal with standard deviation one: sqrt(2 ln 2)."""
MAD_TO_SIGMA = 1.4826
"""The standard deviation of a normal distribution over its median absolute deviation."""


def robust_sigma(residuals: npt.NDArray[Any]) -> float:
    """Return the standard deviation of a normal with the residuals' median absolute deviation about zero.

    Args:
        residuals: Any shape; components count one by one. NaN for an empty array.
    """
    if residuals.size == 0:
        return float("nan")
    return MAD_TO_SIGMA * float(np.median(np.abs(residuals)))
