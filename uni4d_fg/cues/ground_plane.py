"""The ground of a scene: the plane that many static points lie on, that none are under, and that cameras are above.

Depth that is interpolated between points knows nothing of the ground below the lowest of them, nor of that between a
thing's feet and the wall behind it. The ground continues there: nothing of the static scene is farther than it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, rows_by_group
from uni4d_fg.geometry.camera import unproject
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_LEVEL = np.cos(np.radians(50.0))
"""Cosine of the largest angle between the ground's normal and the cameras' mean up direction."""
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
_TRIALS = 20_000
"""Where a twentieth of the points is ground, two or three of these are three points of it ..."""
_JUDGED = 1_000
"""... each judged by so many points ..."""
_REFINED = 50
"""... and so many of the best refined: one of three points that are near each other is tilted by their noise."""
_MAX_POINTS = 10_000
_AT_ONCE = 1_000
"""Planes that are judged at once: more take more memory, not less time."""
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

    def holds(self, points: FloatArray, distance: FloatArray) -> BoolArray:
        """Return which points (N, 3) lie on it, (N,); ``distance`` (N,) is that from the nearest camera."""
        return _on(self, points, _NEAR * distance)


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

    def at(self, observations: Observations) -> FloatArray:
        """Return the inverse depth (N,) of the ground at observations, at real pixels; 0 where it is not seen."""
        inverse = np.zeros(len(observations))
        for frame, rows in enumerate(rows_by_group(observations.frame, len(self.world_T_cam))):
            inverse[rows] = self.inverse_depth(observations.uv[rows], frame)
        return inverse

    def seen_through(self, observations: Observations, inverse: FloatArray) -> bool:
        """Tell whether too much is farther than the plane, as a floor is that is seen beside a table.

        Args:
            observations: N, at real pixels.
            inverse: (N,) inverse depth of their points, NaN where unknown.
        """
        known = np.isfinite(inverse)
        farther = self.at(observations.select(known)) > _FARTHER * inverse[known]
        return float(farther.mean()) > _SEEN_THROUGH


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
    best, most = None, 0
    for plane in _likely(points, near, up, centers, rng):
        refined = _refined(plane, points, near, up)
        if refined is None or refined.normal @ up <= _LEVEL or not (centers @ refined.normal > refined.offset).all():
            continue
        # By what lies on it as closely as it was fitted: a wider band has more of a wall that it ends at.
        more = _more_on_it(refined.normal[None], np.array([refined.offset]), points, near, _REFINEMENTS[-1])
        if more[0] > most:
            best, most = refined, more[0]
    if best is None:
        return None
    on_it = _on(best, points, near)
    if np.count_nonzero(on_it) < max(_MIN_ON_IT, _MIN_SHARE * len(points)):
        return None
    spread = np.linalg.svd(points[on_it] - points[on_it].mean(axis=0), compute_uv=False)
    return None if spread[1] < _THIN * spread[0] else best


def _likely(
    points: FloatArray, near: FloatArray, up: FloatArray, centers: FloatArray, rng: np.random.Generator
) -> list[Plane]:
    """Return planes through three points each that have most points on them, by a part of the points (N, 3)."""
    triple = points[rng.integers(len(points), size=(_TRIALS, 3))]
    normals = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normals, axis=1)
    fine = length > 1e-12
    normals, corner = normals[fine] / length[fine, None], triple[fine, 0]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = normals @ up > _LEVEL
    normals, offsets = normals[level], np.sum(normals[level] * corner[level], axis=1)
    above = (normals @ centers.T > offsets[:, None]).all(axis=1)
    normals, offsets = normals[above], offsets[above]
    more = np.zeros(len(normals), np.int64)
    for first in range(0, len(normals), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        more[block] = _more_on_it(normals[block], offsets[block], points[:_JUDGED], near[:_JUDGED])
    best = np.argsort(-more, kind="stable")[:_REFINED]
    return [Plane(normals[i], float(offsets[i])) for i in best.tolist() if more[i] > 0]


def _more_on_it(
    normals: FloatArray, offsets: FloatArray, points: FloatArray, near: FloatArray, part: float = 1.0
) -> IntArray:
    """Return how many more points lie on planes (M, 3), (M,) than under them; 0 where too many are under them.

    On a plane is what is as near as this part of ``near`` (N,).
    """
    height = normals @ points.T - offsets[:, None]
    under = np.count_nonzero(height < -3 * near, axis=1)
    more = np.count_nonzero(np.abs(height) < part * near, axis=1) - under
    return np.where(under > _MAX_UNDER * len(points), 0, more)


def _refined(plane: Plane, points: FloatArray, near: FloatArray, up: FloatArray) -> Plane | None:
    """Fit a plane to what lies on it, a few times; None if nothing does."""
    for part in _REFINEMENTS:
        on_it = _on(plane, points, part * near)
        if np.count_nonzero(on_it) < 3:
            return None
        plane = _fitted(points[on_it], near[on_it], up)
    return plane


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
