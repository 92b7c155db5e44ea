"""OpenCV's robust estimators of two-view matrices, for which "none" is an answer."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray


def fundamental_matrix(
    first: FloatArray, second: FloatArray, threshold_px: float, confidence: float, max_trials: int
) -> FloatArray | None:
    """Return the fundamental matrix (3, 3) of most pixel pairs (N, 2), or None.

    Args:
        first: (N, 2) px.
        second: (N, 2) px.
        threshold_px: Distance to the epipolar line up to which a pair agrees.
        confidence: Probability that the best was tried, at which trials end.
        max_trials: Trials at most.
    """
    try:
        matrix, _ = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, threshold_px, confidence, max_trials)
    except cv2.error:  # MAGSAC asserts that it has a model, also where no trial gave one
        return None
    return None if matrix is None or matrix.shape != (3, 3) else np.asarray(matrix, np.float64)


def essential_matrix(
    first: FloatArray, second: FloatArray, threshold: float, confidence: float, max_trials: int
) -> tuple[FloatArray, BoolArray] | None:
    """Return the essential matrix (3, 3) of most pairs of rays and which agree (N,), or None.

    Args:
        first: (N, 2) rays at depth 1.
        second: (N, 2) likewise.
        threshold: Distance to the epipolar line up to which a pair agrees.
        confidence: Probability that the best was tried, at which trials end.
        max_trials: Trials at most.
    """
    try:
        matrix, mask = cv2.findEssentialMat(
            first, second, np.eye(3), method=cv2.USAC_MAGSAC, prob=confidence, threshold=threshold, maxIters=max_trials
        )
    except cv2.error:  # as above
        return None
    if matrix is None or matrix.shape != (3, 3):
        return None
    return np.asarray(matrix, np.float64), np.asarray(mask[:, 0] > 0)
