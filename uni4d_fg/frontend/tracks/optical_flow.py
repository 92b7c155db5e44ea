"""One step of Lucas-Kanade between two images, and the checks that a point has to pass."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray
from uni4d_fg.config.cues import TrackingConfig


def move_points(
    source: ImageArray, target: ImageArray, points: Float32Array, config: TrackingConfig
) -> tuple[BoolArray, Float32Array]:
    """Move points from one gray image to the next.

    A point is dropped if its window has no texture, if the window at its new place looks different, if
    tracking it back misses where it came from, or if it comes too close to the image border.

    Args:
        source: (H, W) uint8, the image in which the points are known.
        target: (H, W) uint8.
        points: (N, 2) px in ``source``.
        config: Window and checks.

    Returns:
        kept: (N,) True for the M points that passed every check.
        moved: (M, 2) their pixels in ``target``.
    """
    kept = np.zeros(len(points), np.bool_)
    if len(points) == 0:
        return kept, points
    moved, ahead = steps_ahead(source, target, points, config)
    candidate = np.flatnonzero(ahead)
    survivors = candidate[comes_back(source, target, points[candidate], moved[candidate], config)]
    kept[survivors] = True
    return kept, moved[survivors]


def steps_ahead(
    source: ImageArray, target: ImageArray, points: Float32Array, config: TrackingConfig
) -> tuple[Float32Array, BoolArray]:
    """Return where points (N, 2) of ``source`` are in ``target``, and whether (N,) they are found inside of it."""
    moved, found = _flow(source, target, points, None, config)
    height, width = target.shape
    border = config.border_px
    inside = (moved >= border).all(axis=1) & (moved <= (width - 1 - border, height - 1 - border)).all(axis=1)
    return moved, np.asarray(found & inside)


def comes_back(
    source: ImageArray, target: ImageArray, points: Float32Array, moved: Float32Array, config: TrackingConfig
) -> BoolArray:
    """Return (N,) whether points (N, 2) that moved to (N, 2) are led back to where they came from."""
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    back, found = _flow(target, source, moved, None, config)
    return np.asarray(found & (np.linalg.norm(back - points, axis=1) <= config.forward_backward_px))


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
    matched, found = _flow(query_image, image, query_points, points, config)
    kept: BoolArray = found & (np.linalg.norm(matched - points, axis=1) <= config.max_drift_px)
    return kept


def _flow(
    source: ImageArray,
    target: ImageArray,
    points: Float32Array,
    guess: Float32Array | None,
    config: TrackingConfig,
) -> tuple[Float32Array, BoolArray]:
    """Return moved points (N, 2) and whether (N,) they were found and look alike.

    With a guess of the result (N, 2) only the finest level of the pyramid is searched.
    """
    moved, status, difference = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(points),
        None if guess is None else guess.copy(),  # overwritten with the result
        winSize=(config.window_px, config.window_px),
        maxLevel=config.pyramid_levels if guess is None else 0,
        criteria=(
            cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
            config.max_iterations,
            config.convergence_px,
        ),
        flags=0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=config.min_texture,
    )
    found = (status.ravel() > 0) & (difference.ravel() <= config.max_patch_error)
    return moved.reshape(-1, 2), found
