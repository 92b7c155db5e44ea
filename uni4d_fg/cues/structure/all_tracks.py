"""Points of all tracks, once the cameras are found with some of them, and which of them move."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.one_surface import strays
from uni4d_fg.cues.structure.triangulation import (
    Points,
    RayBundle,
    directions_far_away,
    median_per_row,
    reprojection_errors,
    triangulate,
)
from uni4d_fg.slam.stages.observations import Observations


def points_of_all_tracks(
    observations: Observations, poses: FloatArray, scene: GrowingScene
) -> tuple[IntArray, Points, BoolArray, BoolArray]:
    """Triangulate every track from the frames with a pose, twice: the second time without what did not fit.

    Args:
        observations: N, at ideal pixels.
        poses: (T, 4, 4) of all frames.
        scene: What tells which frames have a pose, and up to which error, px, a track agrees with its point.

    Returns:
        The tracks (M,); their points, NaN where there is none; which (M,) contradict a static point; and which
        observations (N,) are of another surface than most of their track and take no part, see :mod:`.one_surface`.
    """
    posed = scene.registered[observations.frame]
    observations = observations.select(posed)
    tracks, row = observations.rows()
    limit, huber_px = float(np.median(scene.limit_px)), scene.config.geometric_depth.triangulation_huber_px
    rays = RayBundle(row, poses, observations.frame, observations.uv, scene.intrinsics, len(tracks))
    points = triangulate(rays, huber_px)
    error = points.errors_of(rays)
    stray = np.zeros(len(posed), np.bool_)
    stray[posed] = other = strays(rays, error, limit, huber_px)
    if other.any():
        parted = np.bincount(row, other, len(tracks)) > 0
        points = points.replaced(parted, triangulate(rays.select(~other & parted[row]), huber_px))
        rays = rays.select(~other)
        row, error = rays.row, points.errors_of(rays)
    with np.errstate(invalid="ignore"):
        fits = error <= scene.limit_px[rays.frame]
        moving = points.error_px > limit
    again = np.bincount(row, ~fits, len(tracks)) > 0
    points = points.replaced(again, triangulate(rays.select(fits & again[row]), huber_px))
    with np.errstate(invalid="ignore"):
        wrong = ~(points.error_px <= limit)
    # Rays that part meet behind the cameras: that of nothing that is at rest, unless they are all but parallel.
    parting = ~np.isfinite(points.error_px)
    far = rays.select(parting[row])
    moving |= parting & (_median_error_far_away(far) > limit)
    points.position[wrong | moving] = np.nan
    return tracks, points, moving, stray


def _median_error_far_away(rays: RayBundle) -> FloatArray:
    """Return the median reprojection error (M,) px of points too far to show parallax; 0 for tracks without a ray."""
    position = directions_far_away(rays)
    error = median_per_row(reprojection_errors(rays, position), rays.row, rays.count)
    result: FloatArray = np.where(np.isnan(error), 0.0, error)
    return result
