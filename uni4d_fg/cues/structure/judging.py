"""How well cameras explain tracks: by observations that they were not made from, every part of the picture alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.selection import picture_cells
from uni4d_fg.cues.structure.triangulation import RayBundle, directions_far_away, triangulate
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.slam.stages.observations import Observations

_MISSED = 3.0
"""Errors, in sigmas, are cut here: what moves can be made to fit wrong cameras better than the right ones."""


def held_out(observations: Observations, every: int) -> BoolArray:
    """Return (N,) which observations are kept from a trial: one of ``every`` of each track, never its first or last."""
    _, row = observations.rows()
    position = np.arange(len(row)) - np.searchsorted(row, row)
    last = np.searchsorted(row, row, side="right") - np.searchsorted(row, row) - 1
    # Tracks take turns: not all of them lack the same frame.
    chosen = (position + row) % every == 0
    return np.asarray(chosen & (position > 0) & (position < last))


@dataclass(frozen=True)
class HeldOut:
    """How far a scene is from n observations that it was not made from."""

    error_px: FloatArray
    """(n,) infinite for what has no point, is behind the camera, or is in a frame without a pose."""
    weight: FloatArray
    """(n,) such that every part of the picture in every frame has the same say."""

    @classmethod
    def of(cls, scene: GrowingScene, observations: Observations, image_size: tuple[int, int]) -> HeldOut:
        """Compare a scene with observations of any tracks; ``image_size`` is (height, width), px."""
        part = picture_cells(observations.uv, image_size)
        cell = observations.frame * (int(part.max(initial=0)) + 1) + part
        _, row, count = np.unique(cell, return_inverse=True, return_counts=True)
        return cls(errors_of(scene, observations), 1.0 / count[row])

    def unexplained(self, limit_px: float) -> float:
        """Return the part in [0, 1] that is left unexplained: the mean of the squared errors, cut at a limit."""
        if len(self.error_px) == 0:
            return 1.0
        return float(np.average(np.minimum(self.error_px / limit_px, 1.0) ** 2, weights=self.weight))

    def share_within(self, limit_px: float) -> float:
        """Return the part in [0, 1] that errs by no more than a limit."""
        return float(np.average(self.error_px <= limit_px, weights=self.weight)) if len(self.error_px) else 0.0


def robust_energy(scene: GrowingScene, sigma_px: float) -> float:
    """Return the mean robust energy of a scene's own observations, see :func:`energy_of_cameras`.

    Args:
        scene: Cameras, and tracks.
        sigma_px: Noise of the tracks; of scenes that are compared, one.
    """
    return energy_of_cameras(scene, scene.observations, np.full(len(scene.observations), sigma_px))


def energy_of_cameras(scene: GrowingScene, observations: Observations, sigma_px: FloatArray) -> float:
    """Return the mean robust energy of observations in cameras, every track triangulated, however its rays meet.

    By how many points a scene has, the one of more parallax would win, be it as wrong as it may. What has no point in
    front of the cameras counts as missed.

    Args:
        scene: Its cameras; its points take no part.
        observations: N, of any tracks.
        sigma_px: Noise of each (N,).
    """
    used = scene.registered[observations.frame]
    seen, sigma_px = observations.select(used), sigma_px[used]
    tracks, row = seen.rows()
    rays = RayBundle(row, scene.world_T_cam, seen.frame, seen.uv, scene.intrinsics, len(tracks))
    error = triangulate(rays, scene.config.geometric_depth.triangulation_huber_px).errors_of(rays) / sigma_px
    return float(np.log1p(np.fmin(error, _MISSED) ** 2).mean())


def errors_of(scene: GrowingScene, observations: Observations) -> FloatArray:
    """Return the reprojection error (N,) px of any observations; infinite without point or pose, and behind.

    Tracks whose rays meet at too small an angle for a point of the scene have one here, be it at infinity: else cameras
    that bend the scene until it shows parallax would explain more than those that turn, as the real ones did.
    """
    tracks, _ = scene.observations.rows()
    row = np.minimum(np.searchsorted(tracks, observations.track), len(tracks) - 1)
    known = (tracks[row] == observations.track) & scene.registered[observations.frame]
    x = world_to_camera(scene.world_T_cam[observations.frame], _points_of_all(scene)[row])
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.linalg.norm(observations.uv - project(scene.intrinsics, x), axis=1)
        known &= np.isfinite(error) & (x[:, 2] > NEAR_PLANE)
    result: FloatArray = np.where(known, error, np.inf)
    return result


def _points_of_all(scene: GrowingScene) -> FloatArray:
    """Return the points (M, 3) of a scene, with one for each track that it has none of."""
    position = scene.position.copy()
    missing = ~np.isfinite(position[:, 0])
    rays = scene.registered[scene.observations.frame] & missing[scene.row]
    if not rays.any():
        return position
    seen = scene.observations.select(rays)
    bundle = RayBundle(scene.row[rays], scene.world_T_cam, seen.frame, seen.uv, scene.intrinsics, scene.num_tracks)
    near = triangulate(bundle, scene.config.geometric_depth.triangulation_huber_px)
    for points in (near.position, directions_far_away(bundle)):
        still = ~np.isfinite(position[:, 0]) & missing
        position[still] = points[still]
    return position
