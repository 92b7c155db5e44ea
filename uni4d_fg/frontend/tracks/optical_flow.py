"""Lucas-Kanade between two images, and the checks that a point has to pass."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray
from uni4d_fg.config.cues import TrackingConfig

_BACK_ITERATIONS, _BACK_CONVERGENCE = 10, 0.1
"""The place is compared with a distance: it need not be known better than to this part of that."""


def find(
    source: ImageArray, target: ImageArray, points: Float32Array, guess: Float32Array | None, config: TrackingConfig
) -> tuple[Float32Array, BoolArray]:
    """Find points of one image in another.

    Args:
        source: (H, W) uint8.
        target: (H, W) uint8.
        points: (N, 2) px in ``source``.
        guess: (N, 2) px in ``target``, where only the finest level of the pyramid is searched; None: all levels are.
        config: Window and checks.

    Returns:
        Where the points are (N, 2), px, and whether (N,) they were found, look alike, and keep their distance from the
        border.
    """
    moved, found, difference = _flow(source, target, points, guess, config)
    height, width = target.shape
    limit = (width - 1 - config.border_px, height - 1 - config.border_px)
    inside = (moved >= config.border_px).all(axis=1) & (moved <= limit).all(axis=1)
    return moved, np.asarray(found & inside & (difference <= config.max_patch_error))


def comes_back(
    source: ImageArray,
    target: ImageArray,
    points: Float32Array,
    moved: Float32Array,
    expected: Float32Array,
    config: TrackingConfig,
) -> BoolArray:
    """Return (N,) whether points (N, 2) that moved to (N, 2) are led back to where they came from.

    The search begins where the motion (N, 2) px that was expected would have begun, and goes through the whole pyramid
    where it is NaN. An expectation that knows of the step that is checked would make this no check.
    """
    result = np.zeros(len(points), np.bool_)
    told = np.isfinite(expected[:, 0])
    for rows, guess in ((told, moved[told] - expected[told]), (~told, None)):
        back, found, _ = _flow(target, source, moved[rows], guess, config, roughly=True)
        result[rows] = found & (np.linalg.norm(back - points[rows], axis=1) <= config.forward_backward_px)
    return result


def has_not_drifted(
    query_image: ImageArray,
    image: ImageArray,
    query_points: Float32Array,
    points: Float32Array,
    config: TrackingConfig,
) -> BoolArray:
    """Check that points still lie where their first appearance is found.

    Small errors of the steps add up. The window around each query point is matched to the current image
    directly, starting at the tracked position; it must look the same there and not end up elsewhere.

    Args:
        query_image: (H, W) uint8, the image in which the tracks were started.
        image: (H, W) uint8, the current one.
        query_points: (N, 2) px in ``query_image``.
        points: (N, 2) px in ``image``.
        config: Window and ``max_drift_px``.

    Returns:
        (N,) True where the point may be kept; all True if ``max_drift_px`` is None.
    """
    if config.max_drift_px is None or len(points) == 0:
        return np.ones(len(points), np.bool_)
    matched, found, difference = _flow(query_image, image, query_points, points, config)
    kept: BoolArray = (
        found
        & (difference <= config.max_patch_error)
        & (np.linalg.norm(matched - points, axis=1) <= config.max_drift_px)
    )
    return kept


def _flow(
    source: ImageArray,
    target: ImageArray,
    points: Float32Array,
    guess: Float32Array | None,
    config: TrackingConfig,
    roughly: bool = False,
) -> tuple[Float32Array, BoolArray, Float32Array]:
    """Return moved points (N, 2), whether (N,) they were found, and the mean difference (N,) of gray levels there.

    With a guess of the result (N, 2) only the finest level of the pyramid is searched; then ``roughly`` ends it as soon
    as a check backwards can tell, and leaves out the difference.
    """
    if len(points) == 0:
        return points.copy(), np.zeros(0, np.bool_), np.zeros(0, np.float32)
    iterations, convergence_px = config.max_iterations, config.convergence_px
    if roughly:
        iterations = min(iterations, _BACK_ITERATIONS)
        convergence_px = max(convergence_px, _BACK_CONVERGENCE * config.forward_backward_px)
    moved, status, difference = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(points),
        None if guess is None else guess.copy(),  # overwritten with the result
        winSize=(config.window_px, config.window_px),
        maxLevel=config.pyramid_levels if guess is None else 0,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, convergence_px),
        # OpenCV looks at the windows once more for their difference unless it is asked for eigenvalues in its place.
        flags=(0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW)
        | (cv2.OPTFLOW_LK_GET_MIN_EIGENVALS if roughly else 0),
        minEigThreshold=config.min_texture,
    )
    return moved.reshape(-1, 2), status.ravel() > 0, difference.ravel()
