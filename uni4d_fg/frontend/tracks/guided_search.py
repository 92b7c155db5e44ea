"""One step of many points: most are looked for where they are expected, which spares the search through the pyramid.

A point goes on as it went, but for what the camera does anew: it shakes, and the steps of all points around change
alike. A few points that are searched for through the whole pyramid, the guides, tell how. The same expectation, taken
back from where a point was found, is where the check begins to look for the place that it came from: nothing in it
comes from the step that is checked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.optical_flow import comes_back, find
from uni4d_fg.geometry.nearest_points import NearestPoints

_GUIDE_EVERY = 12
"""One of so many points is a guide."""
_NEIGHBORS = 3
"""The median bears one that was lost or belongs to something else."""
_NEAR_PX = 3.0
"""What is found farther from where it was expected may be something else that looks alike."""

Accept = Callable[[IntArray, Float32Array, Float32Array], BoolArray]
"""Told rows (n,) of points, where they were found (n, 2) px, and the motion (n, 2) px that was expected of them, NaN if
unknown; returns which (n,) are right."""


def move_points(
    source: ImageArray, target: ImageArray, points: Float32Array, velocity: Float32Array, config: TrackingConfig
) -> tuple[BoolArray, Float32Array]:
    """Move points from one gray image to the next.

    A point is dropped if its window has no texture, if the window at its new place looks different, if
    tracking it back misses where it came from, or if it comes too close to the image border.

    Args:
        source: (H, W) uint8, the image in which the points are known.
        target: (H, W) uint8.
        points: (N, 2) px in ``source``.
        velocity: (N, 2) px, the last step of each; NaN where it is not known.
        config: Window and checks.

    Returns:
        kept: (N,) True for the M points that passed every check.
        moved: (M, 2) their pixels in ``target``.
    """

    def check(rows: IntArray, moved: Float32Array, expected: Float32Array) -> BoolArray:
        return comes_back(source, target, points[rows], moved, expected, config)

    return search(source, target, points, velocity, check, config)


def search(
    source: ImageArray,
    target: ImageArray,
    points: Float32Array,
    velocity: Float32Array,
    accept: Accept,
    config: TrackingConfig,
) -> tuple[BoolArray, Float32Array]:
    """Find points again; arguments and results as in :func:`move_points`, but for ``accept``, which checks them.

    1. The guides are searched for through the pyramid.
    2. The others that have a velocity are looked for where it and the change of the guides around lead.
    3. New ones are expected to move as the points around.
    4. What was not found near where it was expected is searched for through the pyramid, and checked as if nothing had
       been expected.
    """
    kept, moved = np.zeros(len(points), np.bool_), points.copy()
    expected = np.full_like(points, np.nan)
    settled = np.zeros(len(points), np.bool_)

    def look(rows: IntArray, guess: Float32Array | None) -> IntArray:
        """Note where points (n,) are, and return those that were found."""
        moved[rows], found = find(source, target, points[rows], guess, config)
        return np.asarray(rows[found])

    def follow(rows: IntArray) -> IntArray:
        """Look for points (n,) where they are expected, and return those that are near."""
        found = look(rows, points[rows] + expected[rows])
        surprise = np.linalg.norm(moved[found] - points[found] - expected[found], axis=1)
        return np.asarray(found[surprise <= _NEAR_PX])

    def check(rows: IntArray) -> None:
        settled[rows] = True
        kept[rows] = accept(rows, moved[rows], expected[rows])

    known = np.isfinite(velocity[:, 0])
    old, new = np.flatnonzero(known), np.flatnonzero(~known)
    leading, others = old[::_GUIDE_EVERY], np.delete(old, np.s_[::_GUIDE_EVERY])
    guides = look(leading, None)
    if len(guides) > _NEIGHBORS:
        settled[leading] = True
        change = moved[guides] - points[guides] - velocity[guides]
        expected[guides] = velocity[guides] + _median_of_others(points[guides], change)
        expected[others] = velocity[others] + _median_around(points[others], points[guides], change)
        check(np.concatenate((guides, follow(others))))
    around = np.flatnonzero(kept)
    if len(around) >= _NEIGHBORS:
        expected[new] = _median_around(points[new], points[around], moved[around] - points[around])
        check(follow(new))
    rest = np.flatnonzero(~settled)
    expected[rest] = np.nan
    check(look(rest, None))
    return kept, moved[kept]


def _median_around(points: Float32Array, neighbors: Float32Array, values: Float32Array) -> Float32Array:
    """Return the medians (N, 2) of the values (M, 2) of those of some neighbors (M, 2) that are nearest to points."""
    _, near = NearestPoints(neighbors).find(points, _NEIGHBORS)
    return _median(values[near])


def _median_of_others(points: Float32Array, values: Float32Array) -> Float32Array:
    """Return the medians (N, 2) of the values (N, 2) of those nearest to each point, itself left out."""
    _, near = NearestPoints(points).find(points, _NEIGHBORS + 1)
    # Of points in one place any may be the nearest: oneself goes last, wherever it is.
    itself = near == np.arange(len(points))[:, None]
    near = np.take_along_axis(near, np.argsort(itself, axis=1, kind="stable"), axis=1)
    return _median(values[near[:, :_NEIGHBORS]])


def _median(values: Float32Array) -> Float32Array:
    """Return the medians (N, 2) over the second axis of (N, k, 2), k odd."""
    middle: Float32Array = np.sort(values, axis=1)[:, values.shape[1] // 2]
    return middle
