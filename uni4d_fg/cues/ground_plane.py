"""The ground of a scene: the plane that many static points lie on, that none are under, and that cameras are above.

Depth that is interpolated between points knows nothing of the ground below the lowest of them, nor of that between a
thing's feet and the wall behind it. The ground continues there: nothing of the static scene is farther than it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, rows_by_group
from uni4d_fg.geometry.camera import unproject
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_MAX_TILT = 50.0
"""Largest angle between the ground's normal and the cameras' mean up direction, degrees."""
_NEAR = 0.015
"""Points that are this far from a plane, as a part of their distance to the nearest camera, lie on it."""
_MAX_UNDER = 0.05
"""Part of the points that may seem to be under the ground by three times that: they are wrong, or it has a hole."""
_MIN_ON_IT, _MIN_SHARE = 40, 0.06
"""So many points, and such a part of them, lie on the ground."""
_FARTHER = 1.15
"""What is farther than the plane by this factor is seen through it ..."""
_SEEN_THROUGH = 0.03
"""... and a plane through which more than this part of all is seen is a table."""
_TRIALS = 3000
_MAX_POINTS = 3000
_REFINEMENTS = (1.0, 1.0, 0.5, 0.5, 0.5)
"""Parts of that distance within which the ground is fitted again: what stands on it is near its feet only."""
_THIN = 0.1
"""Points on the ground that are less wide than this part of their length are a line, which many planes contain."""


@dataclass(frozen=True)
class Plane:
    """Points ``x`` with ``normal . x = offset``, world."""

    normal: FloatArray
    """(3,) of length 1, upwards."""
    offset: float

    def inverse_depth(self, rays: FloatArray, world_T_cam: FloatArray) -> FloatArray:
        """Return the inverse depth (...) at which rays meet the plane, 0 for those that do not.

        Args:
            rays: (..., 3) in the camera, with ``z = 1``.
            world_T_cam: (4, 4), above the plane.
        """
        height = float(self.normal @ world_T_cam[:3, 3]) - self.offset
        down = -(rays @ (world_T_cam[:3, :3].T @ self.normal))
        return np.maximum(down, 0.0) / height


@dataclass(frozen=True)
class Ground:
    """The ground as the frames of a video see it."""

    plane: Plane
    world_T_cam: FloatArray
    """(T, 4, 4)."""
    camera: CameraModel

    def inverse_depth(self, uv: FloatArray, frame: int) -> FloatArray:
        """Return the inverse depth (N,) of the ground at pixels (N, 2) of a frame; 0 where it is not seen."""
        ideal = self.camera.ideal(uv, np.full(len(uv), frame))
        rays = unproject(self.camera.intrinsics, ideal, np.ones(len(uv)))
        return np.nan_to_num(self.plane.inverse_depth(rays, self.world_T_cam[frame]))

    def seen_through(self, observations: Observations, inverse: FloatArray) -> bool:
        """Tell whether too much is farther than the plane, as a floor is that is seen beside a table.

        Args:
            observations: N, at real pixels.
            inverse: (N,) inverse depth of their points, NaN where unknown.
        """
        known = np.flatnonzero(np.isfinite(inverse))
        farther = [
            self.inverse_depth(observations.uv[known[rows]], frame) > _FARTHER * inverse[known[rows]]
            for frame, rows in enumerate(rows_by_group(observations.frame[known], len(self.world_T_cam)))
        ]
        return float(np.concatenate(farther).mean()) > _SEEN_THROUGH


def find_ground(points: FloatArray, distance: FloatArray, world_T_cam: FloatArray) -> Plane | None:
    """Find the ground among static points; None if there is none.

    Args:
        points: (N, 3) world.
        distance: (N,) from the nearest camera that saw each.
        world_T_cam: (T, 4, 4).
    """
    if len(points) < _MIN_ON_IT:
        return None
    rng = np.random.default_rng(0)
    some = rng.permutation(len(points))[:_MAX_POINTS]
    points, near = points[some], _NEAR * distance[some]
    up = -world_T_cam[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    centers = world_T_cam[:, :3, 3]
    triple = points[rng.integers(len(points), size=(_TRIALS, 3))]
    normals = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normals, axis=1)
    fine = length > 1e-12
    normals, corner = normals[fine] / length[fine, None], triple[fine, 0]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = normals @ up > np.cos(np.radians(_MAX_TILT))
    normals, offsets = normals[level], np.sum(normals[level] * corner[level], axis=1)
    above = (normals @ centers.T > offsets[:, None]).all(axis=1)
    best, most = None, 0
    for normal, offset in zip(normals[above], offsets[above], strict=True):
        height = points @ normal - offset
        under = int(np.count_nonzero(height < -3 * near))
        if under > _MAX_UNDER * len(points):
            continue
        more = int(np.count_nonzero(np.abs(height) < near)) - under
        if more > most:
            best, most = Plane(normal, float(offset)), more
    if best is None:
        return None
    for part in _REFINEMENTS:
        on_it = _on(best, points, part * near)
        if np.count_nonzero(on_it) < 3:
            return None
        best = _fitted(points[on_it], near[on_it], up)
    on_it = _on(best, points, near)
    if np.count_nonzero(on_it) < max(_MIN_ON_IT, _MIN_SHARE * len(points)):
        return None
    spread = np.linalg.svd(points[on_it] - points[on_it].mean(axis=0), compute_uv=False)
    if spread[1] < _THIN * spread[0] or not (centers @ best.normal > best.offset).all():
        return None
    return best


def _on(plane: Plane, points: FloatArray, near: FloatArray) -> BoolArray:
    return np.asarray(np.abs(points @ plane.normal - plane.offset) < near)


def _fitted(points: FloatArray, near: FloatArray, up: FloatArray) -> Plane:
    """Fit a plane by least squares, each point weighted by how near it has to be."""
    weight = 1.0 / np.maximum(near, 1e-12) ** 2
    weight /= weight.sum()
    mean = weight @ points
    away = points - mean
    normal = np.linalg.eigh((away * weight[:, None]).T @ away)[1][:, 0]
    normal = normal if normal @ up > 0 else -normal
    return Plane(normal, float(normal @ mean))
