r"""Points from rays: many tracks at once, each from all the frames that see it.

A start is the point nearest to all rays, ``sum_i (I - d_i d_i^T)(p - c_i) = 0``; a few Gauss-Newton steps on
the reprojection error with a Huber kernel follow. The covariance at the end, ``sigma^2 (J^T J)^-1``, gives
the standard deviation of the inverse depth in each frame:

    sigma(1/z) = sigma(z) / z^2.

The inverse depth of a far point is known well even where its depth is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, sum_rows
from uni4d_fg.factors.projection import chain_to_world_point, projection_derivatives
from uni4d_fg.geometry.camera import NEAR_PLANE, project, unproject, world_to_camera

_STEPS = 8
_RIDGE = 1e-9
"""Part of the trace that makes a matrix safe to invert; rays with a smaller eigenvalue are parallel."""
_CONVERGED = 1e-5
"""A step below this part of the distance ends the refinement of a point."""


@dataclass(frozen=True)
class RayBundle:
    """N rays, each of one of M tracks."""

    row: IntArray
    """(N,) track of each ray, 0 .. M - 1."""
    world_T_cam: FloatArray
    """(N, 4, 4) camera of each ray."""
    uv: FloatArray
    """(N, 2) px."""
    intrinsics: FloatArray
    """(4,) px."""
    count: int
    """Number of tracks M."""

    def select(self, keep: BoolArray) -> RayBundle:
        """Return the rays with ``keep`` (N,), of the same M tracks."""
        return RayBundle(self.row[keep], self.world_T_cam[keep], self.uv[keep], self.intrinsics, self.count)


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

    def errors_of(self, rays: RayBundle) -> FloatArray:
        """Return the reprojection error (N,) px of rays to these points; NaN without a point."""
        error: FloatArray = np.linalg.norm(_residual(rays, self.position), axis=1)
        return error


def triangulate(rays: RayBundle, huber_px: float) -> Points:
    """Triangulate M tracks; one with fewer than two rays, or with parallel ones, is NaN.

    Args:
        rays: What the frames see.
        huber_px: Reprojection errors above this count less, px.
    """
    center = rays.world_T_cam[:, :3, 3]
    in_camera: FloatArray = unproject(rays.intrinsics, rays.uv, np.ones(len(rays.uv)))
    direction = np.einsum("nij,nj->ni", rays.world_T_cam[:, :3, :3], in_camera)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    matrix = sum_rows(across, rays.row, rays.count)
    right = sum_rows(np.einsum("nij,nj->ni", across, center), rays.row, rays.count)
    # Parallel rays leave one direction open: the smallest eigenvalue is about (angle)^2 / 2.
    solvable = np.linalg.eigvalsh(matrix)[:, 0] > _RIDGE
    position = np.full((rays.count, 3), np.nan)
    position[solvable] = np.linalg.solve(matrix[solvable], right[solvable][..., None])[..., 0]
    position, information = _refine(rays, position, huber_px)
    z = world_to_camera(rays.world_T_cam, position[rays.row])[:, 2]
    with np.errstate(invalid="ignore"):
        behind = np.bincount(rays.row, ~(z > NEAR_PLANE), rays.count) > 0
    position[behind] = np.nan
    error = np.linalg.norm(_residual(rays, position), axis=1)
    return Points(position, information, ray_angles(rays, position), median_per_row(error, rays.row, rays.count))


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
    to_camera = rays.world_T_cam[:, :3, 3] - position[rays.row]
    to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-12)
    order = np.argsort(rays.row, kind="stable")
    start = np.searchsorted(rays.row[order], np.arange(rays.count))
    first = to_camera[order[np.minimum(start, max(len(order) - 1, 0))]]
    cross = np.linalg.norm(np.cross(first[rays.row], to_camera), axis=1)
    angle = np.arctan2(cross, np.sum(first[rays.row] * to_camera, axis=1))
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
    along = np.linalg.solve(_padded(information), np.broadcast_to(axis, position.shape)[..., None])[..., 0]
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


def _refine(rays: RayBundle, position: FloatArray, huber_px: float) -> tuple[FloatArray, FloatArray]:
    """Lower the robust reprojection error of every point; return positions and information (M, 3, 3)."""
    position = position.copy()
    information = np.zeros((rays.count, 3, 3))
    moving: BoolArray = np.asarray(np.isfinite(position).all(axis=1))
    for _ in range(_STEPS):
        tracks = np.flatnonzero(moving)
        if len(tracks) == 0:
            break
        used = moving[rays.row]
        row = np.searchsorted(tracks, rays.row[used])
        poses = rays.world_T_cam[used]
        x = world_to_camera(poses, position[tracks][row])
        by_x, _ = projection_derivatives(np.broadcast_to(rays.intrinsics, (len(x), 4)), x)
        jacobian = chain_to_world_point(by_x, poses)
        residual = rays.uv[used] - project(rays.intrinsics, x)
        weight = 1.0 / np.maximum(np.linalg.norm(residual, axis=1) / huber_px, 1.0)
        hessian, gradient = _normal_equations(jacobian, residual, weight, row, len(tracks))
        step = np.linalg.solve(_padded(hessian), gradient[..., None])[..., 0]
        # A step longer than the distance to the cameras leads nowhere.
        nearest = np.full(len(tracks), np.inf)
        np.minimum.at(nearest, row, np.linalg.norm(x, axis=1))
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 0.5 * nearest / np.maximum(length, 1e-12))[:, None]
        position[tracks] += step
        information[tracks] = hessian
        moving[tracks[length < _CONVERGED * nearest]] = False
    return position, information


def _normal_equations(
    jacobian: FloatArray, residual: FloatArray, weight: FloatArray, row: IntArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return J'WJ (count, 3, 3) and J'Wr (count, 3), summed over the observations of each row.

    Written out by columns: products of many tiny matrices cost numpy several times their arithmetic.
    """
    hessian, gradient = np.empty((count, 3, 3)), np.empty((count, 3))
    u, v = np.ascontiguousarray(jacobian.transpose(1, 2, 0))
    for a in range(3):
        weighted_u, weighted_v = weight * u[a], weight * v[a]
        gradient[:, a] = np.bincount(row, weighted_u * residual[:, 0] + weighted_v * residual[:, 1], count)
        for b in range(a + 1):
            hessian[:, a, b] = hessian[:, b, a] = np.bincount(row, weighted_u * u[b] + weighted_v * v[b], count)
    return hessian, gradient


def _padded(information: FloatArray) -> FloatArray:
    """Return (M, 3, 3) matrices made safe to invert."""
    trace = np.trace(information, axis1=1, axis2=2)
    result: FloatArray = information + (_RIDGE * trace + 1e-12)[:, None, None] * np.eye(3)
    return result


def _residual(rays: RayBundle, position: FloatArray) -> FloatArray:
    x = world_to_camera(rays.world_T_cam, position[rays.row])
    result: FloatArray = rays.uv - project(rays.intrinsics, x)
    return result
