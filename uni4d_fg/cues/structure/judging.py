"""How well cameras explain tracks: by observations that they were not made from, every part of the picture alike."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.selection import picture_cells
from uni4d_fg.cues.structure.triangulation import RayBundle, triangulate
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.slam.stages.observations import Observations

_LOST = 100.0
"""Errors, in sigmas, are cut here."""


def held_out(observations: Observations, every: int) -> BoolArray:
    """Return (N,) which observations are kept from a trial: one of ``every`` of each track, never its first or last."""
    _, row = observations.rows()
    position = np.arange(len(row)) - np.searchsorted(row, row)
    last = np.searchsorted(row, row, side="right") - np.searchsorted(row, row) - 1
    # Tracks take turns: not all of them lack the same frame.
    chosen = (position + row) % every == 0
    return np.asarray(chosen & (position > 0) & (position < last))


def unexplained(scene: GrowingScene, observations: Observations, image_size: tuple[int, int]) -> float:
    """Return the part in [0, 1] of what was seen that a scene leaves unexplained.

    The mean over parts of the picture and frames of the squared reprojection error, cut at ``max_reprojection_px``.
    What has no point, is behind the camera, or is in a frame without a pose counts as fully wrong.

    Args:
        scene: Cameras and points.
        observations: What they are to explain, of any tracks.
        image_size: (height, width), px.
    """
    error = errors_of(scene, observations) / scene.config.geometric_depth.max_reprojection_px
    cell = observations.frame * (int(picture_cells(observations.uv, image_size).max(initial=0)) + 1)
    cell = cell + picture_cells(observations.uv, image_size)
    _, row, count = np.unique(cell, return_inverse=True, return_counts=True)
    return float(np.average(np.minimum(error, 1.0) ** 2, weights=1.0 / count[row])) if len(row) else 1.0


def robust_energy(scene: GrowingScene, sigma_px: float) -> float:
    """Return the mean robust energy of a scene's own observations, every track triangulated, however its rays meet.

    By how many points a scene has, the one of more parallax would win, be it as wrong as it may. What has no point in
    front of the cameras counts as lost.

    Args:
        scene: Cameras, and tracks.
        sigma_px: Noise of the tracks; of scenes that are compared, one.
    """
    used = scene.registered[scene.observations.frame]
    seen = scene.observations.select(used)
    rays = RayBundle(
        scene.row[used], scene.world_T_cam, seen.frame, seen.uv, scene.intrinsics, scene.num_tracks
    )  # fmt: skip
    error = triangulate(rays, scene.config.geometric_depth.triangulation_huber_px).errors_of(rays) / sigma_px
    return float(np.log1p(np.fmin(error, _LOST) ** 2).mean())


def errors_of(scene: GrowingScene, observations: Observations) -> FloatArray:
    """Return the reprojection error (N,) px of any observations; infinite without point or pose, and behind."""
    tracks, _ = scene.observations.rows()
    row = np.minimum(np.searchsorted(tracks, observations.track), len(tracks) - 1)
    known = (tracks[row] == observations.track) & scene.registered[observations.frame]
    x = world_to_camera(scene.world_T_cam[observations.frame], scene.position[row])
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.linalg.norm(observations.uv - project(scene.intrinsics, x), axis=1)
        known &= np.isfinite(error) & (x[:, 2] > NEAR_PLANE)
    result: FloatArray = np.where(known, error, np.inf)
    return result
