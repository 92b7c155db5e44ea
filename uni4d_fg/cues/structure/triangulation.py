r"""Points from rays: many tracks at once, each from all the frames that see it.

A start is the point nearest to all rays, ``sum_i (I - d_i d_i^T)(p - c_i) = 0``; a few Gauss-Newton steps on
the reprojection error with a Huber kernel follow. The covariance at the end, ``sigma^2 (J^T J)^-1``, gives
the standard deviation of the inverse depth in each frame:

    sigma(1/z) = sigma(z) / z^2.

The inverse depth of a far point is known well even where its depth is not. With the C++ extension all but the start is
done there, with the same operations in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.geometry.camera import (
    NEAR_PLANE,
    inverse_depth,
    inverse_depth_slope,
    project,
    seen_from,
    unproject,
    world_to_camera,
)
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.threads import thread_count

_STEPS = 8
_RIDGE = 1e-9
"""Part of the trace that makes a matrix safe to invert; rays with a smaller eigenvalue are parallel."""
_FAR = 1e5
"""Points far away are so many times farther than the cameras are apart."""
_HUBER = 3.0
"""Standard deviations beyond which an observation of an inverse depth counts less."""
_CONVERGED = 1e-5
"""A step below this part of the distance ends the refinement of a point."""


@dataclass(frozen=True)
class RayBundle:
    """N rays, each of one of M tracks, from T cameras."""

    row: IntArray
    """(N,) track of each ray, 0 .. M - 1."""
    world_T_cam: FloatArray
    """(T, 4, 4)."""
    frame: IntArray
    """(N,) camera of each ray, 0 .. T - 1."""
    uv: FloatArray
    """(N, 2) px."""
    intrinsics: FloatArray
    """(4,) px."""
    count: int
    """Number of tracks M."""

    def arrays(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
        """Return what the extension takes of them: track, camera and pixel of each, poses, intrinsics."""
        return (
            np.ascontiguousarray(self.row), np.ascontiguousarray(self.frame), np.ascontiguousarray(self.uv),
            np.ascontiguousarray(self.world_T_cam), np.ascontiguousarray(self.intrinsics),
        )  # fmt: skip

    def origins(self) -> FloatArray:
        """Return the world's origin (T, 3) in the cameras."""
        rotation = self.world_T_cam[:, :3, :3].swapaxes(1, 2)
        origin: FloatArray = -(rotation @ self.world_T_cam[:, :3, 3:])[:, :, 0]
        return origin

    def select(self, keep: BoolArray) -> RayBundle:
        """Return the rays with ``keep`` (N,), of the same M tracks."""
        return RayBundle(self.row[keep], self.world_T_cam, self.frame[keep], self.uv[keep], self.intrinsics, self.count)


@dataclass(frozen=True)
class Points:
    """M triangulated points; NaN where the rays do not meet in front of the cameras."""

    position: FloatArray
    """(M, 3) world."""
    information: FloatArray
    """(M, 3, 3) inverse covariance, for reprojection errors of 1 px."""
    angle: FloatArray
    """(M,) largest angle between two rays (approximately: between the ends of the cameras' arc), rad."""
    error_px: FloatArray
    """(M,) median reprojection error."""

    def replaced(self, which: BoolArray, other: Points) -> Points:
        """Return these points, but those with ``which`` (M,) of another M points."""
        return Points(
            np.where(which[:, None], other.position, self.position),
            np.where(which[:, None, None], other.information, self.information),
            np.where(which, other.angle, self.angle),
            np.where(which, other.error_px, self.error_px),
        )

    def errors_of(self, rays: RayBundle) -> FloatArray:
        """Return the reprojection error (N,) px of rays to these points; NaN without a point."""
        off = rays.uv - project(rays.intrinsics, seen_from(rays.world_T_cam, rays.frame, self.position[rays.row]))
        return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def triangulate(rays: RayBundle, huber_px: float) -> Points:
    """Triangulate M tracks; one with fewer than two rays, or with parallel ones, is NaN.

    Args:
        rays: What the frames see.
        huber_px: Reprojection errors above this count less, px.
    """
    core, _ = find_extension()
    return _triangulate_numpy(rays, huber_px) if core is None else _triangulate_cpp(core, rays, huber_px)


def _triangulate_numpy(rays: RayBundle, huber_px: float) -> Points:
    """Do what ``cpp_factors/src/triangulation.cpp`` does."""
    position, information = _refine(rays, _start(*_nearest_to_all(rays)), huber_px)
    x = seen_from(rays.world_T_cam, rays.frame, position[rays.row])
    with np.errstate(invalid="ignore"):
        behind = np.bincount(rays.row, ~(x[:, 2] > NEAR_PLANE), rays.count) > 0
    position[behind] = np.nan
    off = rays.uv - project(rays.intrinsics, x)
    error = np.where(behind[rays.row], np.nan, np.hypot(off[:, 0], off[:, 1]))
    angle = _ray_angles_numpy(rays, position)
    return Points(position, information, angle, median_per_row(error, rays.row, rays.count))


def _triangulate_cpp(core: Any, rays: RayBundle, huber_px: float) -> Points:
    arrays = rays.arrays()
    start = _start(*core.ray_equations(*arrays, tracks=rays.count))
    found = core.refine_points(
        *arrays, np.ascontiguousarray(rays.origins()), start, huber_px=huber_px, steps=_STEPS, converged=_CONVERGED,
        ridge=_RIDGE, threads=thread_count(),
    )  # fmt: skip
    return Points(*found)


def _start(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the points (M, 3) nearest to all rays of a track, NaN where these are parallel."""
    # Parallel rays leave one direction open: the smallest eigenvalue is about (angle)^2 / 2.
    solvable = np.linalg.eigvalsh(matrix)[:, 0] > _RIDGE
    position = np.full((len(matrix), 3), np.nan)
    position[solvable] = np.linalg.solve(matrix[solvable], right[solvable][..., None])[..., 0]
    return position


def directions_far_away(rays: RayBundle) -> FloatArray:
    """Return points (M, 3) in the mean direction of the rays of each track, too far to show parallax; NaN without."""
    in_camera = unproject(rays.intrinsics, rays.uv, np.ones(len(rays.uv)))
    in_camera /= np.linalg.norm(in_camera, axis=1, keepdims=True)
    direction = (rays.world_T_cam[rays.frame, :3, :3] @ in_camera[..., None])[..., 0]
    total = np.stack([np.bincount(rays.row, direction[:, a], rays.count) for a in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    centers = rays.world_T_cam[np.unique(rays.frame), :3, 3].reshape(-1, 3)
    if len(centers) == 0:
        return np.full((rays.count, 3), np.nan)
    distance = _FAR * max(float(np.linalg.norm(np.ptp(centers, axis=0))), NEAR_PLANE)
    result: FloatArray = centers.mean(axis=0) + distance * total / np.where(length > 0, length, np.nan)
    return result


def directions_along(rays: RayBundle, which: IntArray) -> FloatArray:
    """Return the directions (M, 3) of some rays (M,) in the world, of depth one in their cameras."""
    in_camera = unproject(rays.intrinsics, rays.uv[which], np.ones(len(which)))
    rotation = rays.world_T_cam[rays.frame[which], :3, :3]
    return np.asarray((rotation @ in_camera[..., None])[..., 0])


def inverse_depths_along(rays: RayBundle, reference: IntArray, sigma_px: float) -> tuple[FloatArray, FloatArray]:
    """Return the inverse depth (M,) of each track along one of its rays, and its standard deviation (M,).

    Other than a point, it is found of what is infinitely far away as well, where it is zero. The error of the reference
    is fitted with it, as a shift that all frames share: they differ by small rotations.

    Args:
        rays: N.
        reference: (M,) the ray of each track.
        sigma_px: Noise of the tracks; of a track that fits worse, its own.
    """
    rotation = rays.world_T_cam[rays.frame, :3, :3].swapaxes(1, 2)
    center = rays.world_T_cam[:, :3, 3]
    start = directions_along(rays, reference)[rays.row]
    start = (rotation @ start[..., None])[..., 0]
    away = center[rays.frame[reference]][rays.row] - center[rays.frame]
    away = (rotation @ away[..., None])[..., 0]
    focal = rays.intrinsics[:2]
    with np.errstate(divide="ignore"):
        behind = np.where(away[:, 2] < 0, -start[:, 2] / away[:, 2], np.inf)
    nearest = np.full(rays.count, np.inf)
    np.minimum.at(nearest, rays.row, behind)

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(rays.row, values, rays.count), np.float64)

    def centered(values: FloatArray, weight: FloatArray) -> FloatArray:
        mean = np.stack([total(weight * column) for column in values.T], axis=1) / total(weight)[:, None]
        return np.asarray(values - mean[rays.row])

    inverse, weight = np.zeros(rays.count), np.ones(len(rays.row))
    squared, information = np.zeros((2, rays.count))
    for _ in range(_STEPS):
        # In units of the depth along the reference: finite at infinity, where only the direction counts.
        x = start + inverse[rays.row, None] * away
        g = 1.0 / np.maximum(x[:, 2], NEAR_PLANE)[:, None]
        off = centered(rays.uv - focal * x[:, :2] * g, weight)
        slope = centered(focal * (away[:, :2] - x[:, :2] * g * away[:, 2:]) * g, weight)
        squared, information = total(weight * np.sum(off**2, axis=1)), total(weight * np.sum(slope**2, axis=1))
        step = total(weight * np.sum(slope * off, axis=1)) / np.maximum(information, 1e-12)
        # No farther than half the way to where one of the cameras would be.
        inverse = np.minimum(inverse + step, 0.5 * (inverse + nearest))
        weight = 1.0 / np.maximum(np.hypot(off[:, 0], off[:, 1]) / (_HUBER * sigma_px), 1.0)
    freedom = np.maximum(2.0 * np.bincount(rays.row, minlength=rays.count) - 3.0, 1.0)
    variance = np.maximum(squared / freedom, sigma_px**2)
    return inverse, np.sqrt(variance / np.maximum(information, 1e-12))


def sound(points: Points, max_error_px: float, min_angle_deg: float) -> BoolArray:
    """Return which triangulated points (M,) fit their tracks and have rays that meet at enough of an angle."""
    with np.errstate(invalid="ignore"):
        fits = (points.error_px <= max_error_px) & (points.angle >= np.radians(min_angle_deg))
    result: BoolArray = fits & np.isfinite(points.position).all(axis=1)
    return result


def ray_angles(rays: RayBundle, position: FloatArray) -> FloatArray:
    """Return the angle (M,) under which each point (M, 3) sees its cameras, rad.

    The angle between the first camera and the one farthest from it in angle: at least half of the largest.
    """
    core, _ = find_extension()
    if core is None:
        return _ray_angles_numpy(rays, position)
    found: FloatArray = core.ray_angles(*rays.arrays(), np.ascontiguousarray(position))
    return found


def reprojection_errors(rays: RayBundle, position: FloatArray) -> FloatArray:
    """Return the reprojection error (N,) px of points (M, 3) along their rays; infinite without a point or behind."""
    core, _ = find_extension()
    if core is not None:
        found: FloatArray = core.reprojection_errors(*rays.arrays(), np.ascontiguousarray(position))
        return found
    x = seen_from(rays.world_T_cam, rays.frame, position[rays.row])
    with np.errstate(invalid="ignore"):
        off = rays.uv - project(rays.intrinsics, x)
        error = np.hypot(off[:, 0], off[:, 1])
        usable = np.isfinite(error) & (x[:, 2] > NEAR_PLANE)
    result: FloatArray = np.where(usable, error, np.inf)
    return result


def _ray_angles_numpy(rays: RayBundle, position: FloatArray) -> FloatArray:
    if len(rays.row) == 0:
        return np.full(rays.count, np.nan)
    away = [rays.world_T_cam[:, a, 3][rays.frame] - position[:, a][rays.row] for a in range(3)]
    order = np.argsort(rays.row, kind="stable")
    start = np.searchsorted(rays.row[order], np.arange(rays.count))
    first = order[np.minimum(start, len(order) - 1)][rays.row]
    x, y, z = away
    u, v, w = (part[first] for part in away)
    across = (v * z - w * y) ** 2 + (w * x - u * z) ** 2 + (u * y - v * x) ** 2
    angle = np.arctan2(np.sqrt(across), u * x + v * y + w * z)
    out = np.full(rays.count, -np.inf)
    seen = np.isfinite(angle)
    np.maximum.at(out, rays.row[seen], angle[seen])
    result: FloatArray = np.where(np.isfinite(out), out, np.nan)
    return result


def inverse_depth_sigma(
    world_T_cam: FloatArray, position: FloatArray, information: FloatArray, sigma_px: float
) -> FloatArray:
    """Return the standard deviation of the inverse depth of points in one camera, (M,).

    Args:
        world_T_cam: (4, 4).
        position: (M, 3) world.
        information: (M, 3, 3) as in :class:`Points`.
        sigma_px: Noise of the tracks, px.
    """
    z = world_to_camera(world_T_cam, position)[:, 2]
    axis = world_T_cam[:3, 2]
    along = _solved(_padded(information), np.broadcast_to(axis, position.shape))
    variance = along @ axis
    result: FloatArray = sigma_px * np.sqrt(np.maximum(variance, 0.0)) / np.maximum(z, NEAR_PLANE) ** 2
    return result


def median_per_row(values: FloatArray, row: IntArray, count: int) -> FloatArray:
    """Return the (lower) median of the values (N,) of each row, (count,); NaN for a row without any."""
    order = np.lexsort([values, row])
    start = np.searchsorted(row[order], np.arange(count + 1))
    middle = np.minimum((start[:-1] + start[1:] - 1) // 2, max(len(values) - 1, 0))
    found = start[1:] > start[:-1]
    result: FloatArray = np.where(found, values[order][middle] if len(values) else np.nan, np.nan)
    return result


def _nearest_to_all(rays: RayBundle) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations (M, 3, 3) and (M, 3) of the point nearest to all rays of each track."""
    x, y = (rays.uv - rays.intrinsics[2:]).T / rays.intrinsics[:2, None]
    rotation = rays.world_T_cam[:, :3, :3]
    direction = [
        rotation[:, a, 0][rays.frame] * x + rotation[:, a, 1][rays.frame] * y + rotation[:, a, 2][rays.frame]
        for a in range(3)
    ]
    length = np.sqrt(sum(part * part for part in direction))
    direction = [part / length for part in direction]
    center = [rays.world_T_cam[:, a, 3][rays.frame] for a in range(3)]
    along = sum(d * c for d, c in zip(direction, center, strict=True))
    matrix, right = np.empty((rays.count, 3, 3)), np.empty((rays.count, 3))
    for a in range(3):
        right[:, a] = np.bincount(rays.row, center[a] - direction[a] * along, rays.count)
        for b in range(a + 1):
            across = float(a == b) - direction[a] * direction[b]
            matrix[:, a, b] = matrix[:, b, a] = np.bincount(rays.row, across, rays.count)
    return matrix, right


def _refine(rays: RayBundle, position: FloatArray, huber_px: float) -> tuple[FloatArray, FloatArray]:
    """Lower the robust reprojection error of every point; return positions and information (M, 3, 3)."""
    position = position.copy()
    information = np.zeros((rays.count, 3, 3))
    tracks = np.flatnonzero(np.isfinite(position).all(axis=1))
    views = _Views.of(rays, tracks)
    for _ in range(_STEPS):
        if len(tracks) == 0:
            break
        hessian, gradient, nearest = views.normal_equations(position[tracks], huber_px)
        step = _solved(_padded(hessian), gradient)
        # A step longer than the distance to the cameras leads nowhere.
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 0.5 * nearest / np.maximum(length, 1e-12))[:, None]
        position[tracks] += step
        information[tracks] = hessian
        moving: BoolArray = ~(length < _CONVERGED * nearest)
        if not moving.all():
            tracks, views = tracks[moving], views.of_tracks(moving)
    return position, information


@dataclass(frozen=True)
class _Views:
    """What n rays of m tracks see, written out by columns: many tiny matrices cost NumPy several times their work."""

    row: IntArray
    """(n,) track of each ray, 0 .. m - 1."""
    columns: FloatArray
    """(14, n): the rotation into the camera, row by row, the world's origin in its axes, and the pixel."""
    intrinsics: FloatArray
    """(4,) px."""
    count: int
    """m."""

    @classmethod
    def of(cls, rays: RayBundle, tracks: IntArray) -> _Views:
        """Return the rays of some tracks (m,), ascending."""
        local = np.full(rays.count, -1, dtype=np.int64)
        local[tracks] = np.arange(len(tracks))
        used = np.flatnonzero(local[rays.row] >= 0)
        frame = rays.frame[used]
        rotation = rays.world_T_cam[:, :3, :3].swapaxes(1, 2)
        origin = rays.origins()
        columns = np.empty((14, len(used)))
        for k in range(9):
            columns[k] = rotation[:, k // 3, k % 3][frame]
        for k in range(3):
            columns[9 + k] = origin[:, k][frame]
        columns[12:] = rays.uv[used].T
        return cls(local[rays.row[used]], columns, rays.intrinsics, len(tracks))

    def of_tracks(self, keep: BoolArray) -> _Views:
        """Return the rays of the tracks with ``keep`` (m,)."""
        used = keep[self.row]
        row = (np.cumsum(keep, dtype=np.int64) - 1)[self.row[used]]
        return _Views(row, self.columns[:, used], self.intrinsics, int(np.count_nonzero(keep)))

    def normal_equations(self, position: FloatArray, huber_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return J'WJ (m, 3, 3), J'Wr (m, 3) and the distance (m,) of points (m, 3) from their nearest camera."""
        fx, fy, cx, cy = self.intrinsics
        px, py, pz = (position[:, a][self.row] for a in range(3))
        r = self.columns
        x, y, z = (r[3 * i] * px + r[3 * i + 1] * py + r[3 * i + 2] * pz + r[9 + i] for i in range(3))
        nearest = np.full(self.count, np.inf)
        np.minimum.at(nearest, self.row, x * x + y * y + z * z)
        g, slope = inverse_depth(z), inverse_depth_slope(z)
        off_u, off_v = r[12] - (fx * x * g + cx), r[13] - (fy * y * g + cy)
        weight = 1.0 / np.maximum(np.hypot(off_u, off_v) / huber_px, 1.0)
        along_u, along_v = fx * x * slope, fy * y * slope
        by_u = [fx * g * r[a] + along_u * r[6 + a] for a in range(3)]
        by_v = [fy * g * r[3 + a] + along_v * r[6 + a] for a in range(3)]
        hessian, gradient = np.empty((self.count, 3, 3)), np.empty((self.count, 3))
        for a in range(3):
            weighted_u, weighted_v = weight * by_u[a], weight * by_v[a]
            gradient[:, a] = np.bincount(self.row, weighted_u * off_u + weighted_v * off_v, self.count)
            for b in range(a + 1):
                term = weighted_u * by_u[b] + weighted_v * by_v[b]
                hessian[:, a, b] = hessian[:, b, a] = np.bincount(self.row, term, self.count)
        return hessian, gradient, np.sqrt(nearest)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve positive definite systems (m, 3, 3), (m, 3) by the factors L D L', all at once."""
    d0 = matrix[:, 0, 0]
    l10, l20 = matrix[:, 1, 0] / d0, matrix[:, 2, 0] / d0
    d1 = matrix[:, 1, 1] - l10 * matrix[:, 1, 0]
    l21 = (matrix[:, 2, 1] - l20 * matrix[:, 1, 0]) / d1
    d2 = matrix[:, 2, 2] - l20 * matrix[:, 2, 0] - l21 * l21 * d1
    y1 = right[:, 1] - l10 * right[:, 0]
    y2 = right[:, 2] - l20 * right[:, 0] - l21 * y1
    z = y2 / d2
    y = y1 / d1 - l21 * z
    x = right[:, 0] / d0 - l10 * y - l20 * z
    result: FloatArray = np.stack((x, y, z), axis=1)
    return result


def _padded(information: FloatArray) -> FloatArray:
    """Return (M, 3, 3) matrices made safe to invert."""
    trace = np.trace(information, axis1=1, axis2=2)
    result: FloatArray = information + (_RIDGE * trace + 1e-12)[:, None, None] * np.eye(3)
    return result
