"""Tracks that a static scene would have under its ground: those of what moves along with the camera.

A car ahead that is as fast as the camera stays where it is in the picture, as what is infinitely far away does: a
static scene explains it. But its rays meet the ground before they get there. Ground that other frames see around that
place, on both sides of the ray, is no hole: nothing static is seen through it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.ground_plane import Ground
from uni4d_fg.cues.structure.motion import Structure
from uni4d_fg.cues.structure.triangulation import RayBundle, directions_along, inverse_depths_along
from uni4d_fg.cues.track_certainty import share_of_moving
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import NEAR_PLANE, seen_from
from uni4d_fg.slam.stages.observations import Observations

_SURELY = 3.0
"""Standard deviations by which an inverse depth is below the ground's."""
_GROUND_SIGMA = 0.05
"""Of the ground's inverse depth, relative: it is not quite a plane."""
_FARTHER = 1.3
"""What is farther than the ground by less than this may be a dent of it."""
_AROUND = 0.08
"""Points of the ground within this part of the distance are around the place where a ray meets it ..."""
_MIN_AROUND = 3
"""... and so many of them, on both sides, close it."""
_MOSTLY = 0.6
"""Part of the tracks around each other that are seen through the ground: single ones slide along edges."""
_CLOSED = 0.3
"""Part of these of which the ground is known to be closed: farther away it may not be seen."""
_MIN_TRACKS = 20
"""Fewer are no thing: 0 to 13 are found in clips without one, 190 on a car ahead."""
_MIN_OBSERVATIONS = 4
_LEAST_PX = 0.3
"""Standard deviation of a track, at least."""


def tracks_through(
    ground: Ground, on_ground: FloatArray, structure: Structure, observations: Observations, tracks: Tracks,
    image_size: tuple[int, int],
) -> BoolArray:  # fmt: skip
    """Return which tracks (K,) would be seen through the ground if they stood still.

    Args:
        ground: Of the frames of a video.
        on_ground: (N, 3) points of the static scene that are on it, world.
        structure: Cameras and points. Tracks that are known to move say nothing of what is around them.
        observations: Of its tracks, at real pixels, in the order of tracks and then of time.
        tracks: K tracks.
        image_size: (height, width), px.
    """
    observations = observations.select(structure.registered[observations.frame])
    track, row = observations.rows()
    first = np.searchsorted(row, np.arange(len(track)))
    there = ground.at(observations.select(first))
    known = np.searchsorted(structure.track, track)
    seen_often = np.bincount(row, minlength=len(track)) >= _MIN_OBSERVATIONS
    judged = (there > 0) & seen_often & ~structure.moving[known]
    # Points that are found in front of the ground need no closer look.
    depth = seen_from(structure.world_T_cam, observations.frame[first], structure.points.position[known])[:, 2]
    with np.errstate(invalid="ignore"):
        beyond = judged & ~((depth > NEAR_PLANE) & (depth * there < _FARTHER))
    beyond[beyond] = _surely_beyond(ground, observations.select(beyond[row]), there[beyond], structure.sigma_px)
    closed = beyond.copy()
    closed[beyond] = _closed(ground, observations.select(first[beyond]), there[beyond], on_ground)
    through, others, sure = np.zeros((3, tracks.num_tracks), dtype=bool)
    through[track[beyond]], others[track[judged & ~beyond]], sure[track[closed]] = True, True, True
    if np.count_nonzero(sure) >= _MIN_TRACKS:
        mostly = share_of_moving(tracks, through, others, image_size) > _MOSTLY
        through, sure = through & mostly, sure & mostly
        through &= share_of_moving(tracks, sure, through & ~sure, image_size) > _CLOSED
    return through if np.count_nonzero(through & sure) >= _MIN_TRACKS else np.zeros_like(through)


def _surely_beyond(ground: Ground, observations: Observations, there: FloatArray, sigma_px: float) -> BoolArray:
    """Return which of M tracks are farther than the ground, at inverse depth ``there`` (M,), along their first rays."""
    rays = _rays(ground, observations)
    first = np.searchsorted(rays.row, np.arange(rays.count))
    inverse, sigma = inverse_depths_along(rays, first, max(sigma_px, _LEAST_PX))
    surely = there - inverse > _SURELY * np.hypot(sigma, _GROUND_SIGMA * there)
    return np.asarray(surely & (there > _FARTHER * inverse))


def _closed(ground: Ground, observations: Observations, there: FloatArray, on_ground: FloatArray) -> BoolArray:
    """Return around which places on the ground there are points of it, on both sides of the ray that meets it there.

    Args:
        ground: Of the frames of a video.
        observations: N of different tracks, at real pixels, whose rays meet it.
        there: (N,) inverse depth at which they do.
        on_ground: (M, 3) points of it.
    """
    closed = np.zeros(len(there), dtype=bool)
    if len(on_ground) == 0 or len(there) == 0:
        return closed
    rays = _rays(ground, observations)
    away = directions_along(rays, np.arange(rays.count)) / there[:, None]
    place = ground.world_T_cam[rays.frame, :3, 3] + away
    across = np.cross(ground.plane.normal, away)
    reach = _AROUND * np.linalg.norm(away, axis=1)
    for n, near in enumerate(cKDTree(on_ground).query_ball_point(place, reach)):
        left = (on_ground[near] - place[n]) @ across[n] > 0
        closed[n] = len(near) >= _MIN_AROUND and bool(left.any()) and not left.all()
    return closed


def _rays(ground: Ground, observations: Observations) -> RayBundle:
    """Return the rays of observations at real pixels."""
    ideal = ground.camera.ideal_observations(observations)
    track, row = ideal.rows()
    return RayBundle(row, ground.world_T_cam, ideal.frame, ideal.uv, ground.camera.intrinsics, len(track))
