"""How well two masks agree."""

from __future__ import annotations

import numpy as np


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of what is not 0."""
    return float(np.count_nonzero((first > 0) & (second > 0)) / np.count_nonzero((first > 0) | (second > 0)))
