r"""The pinhole camera: projection, lifting, and a cheirality policy that pushes.

Pixels ``uv`` have x to the right, y down and centers at integers. Camera axes are OpenCV's (x right,
y down, z forward). ``intrinsics`` is ``(fx, fy, cx, cy)`` in pixels; there is no skew or distortion.

A plain projection has no useful gradient behind the camera: the point jumps through infinity. Here the
inverse depth ``1/z`` is continued below ``near`` by its tangent line,

    g(z) = 1/z                     for z >= near
    g(z) = (2 near - z) / near^2   for z <  near

which is continuous with its first derivative and grows as the point moves back, so that the reprojection
error of a point behind the camera is large and its gradient pushes the point to the front.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, IntArray, namespace

NEAR_PLANE = 0.02
"""Depth in meters below which the inverse depth is continued linearly."""


def intrinsics_matrix(intrinsics: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix of (4,) fx, fy, cx, cy."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def inverse_depth(z: Array, near: float = NEAR_PLANE) -> Array:
    """Return g(z) of the module docstring. Args: ``z`` of any shape, meters. Returns the same shape, 1/m."""
    xp = namespace(z)
    safe = xp.where(z >= near, z, near)
    return xp.where(z >= near, 1.0 / safe, (2.0 * near - z) / near**2)


def inverse_depth_slope(z: Array, near: float = NEAR_PLANE) -> Array:
    """Return dg/dz, the derivative of :func:`inverse_depth`; same shape as ``z``, 1/m^2."""
    xp = namespace(z)
    safe = xp.where(z >= near, z, near)
    return -1.0 / (safe * safe)


def project(intrinsics: Array, point_cam: Array, near: float = NEAR_PLANE) -> Array:
    """Project camera-frame points to pixels.

    Args:
        intrinsics: (..., 4) fx, fy, cx, cy in px, broadcast against the points.
        point_cam: (..., 3) points in the camera frame, meters.
        near: Depth below which the inverse depth is continued linearly.

    Returns:
        (..., 2) pixel coordinates.
    """
    xp = namespace(point_cam)
    g = inverse_depth(point_cam[..., 2], near)
    u = intrinsics[..., 0] * point_cam[..., 0] * g + intrinsics[..., 2]
    v = intrinsics[..., 1] * point_cam[..., 1] * g + intrinsics[..., 3]
    return xp.stack((u, v), axis=-1)


def unproject(intrinsics: Array, uv: Array, depth: Array) -> Array:
    """Lift pixels with z-depth to the camera frame.

    Args:
        intrinsics: (..., 4) fx, fy, cx, cy in px.
        uv: (..., 2) pixels.
        depth: (...) z-depth in meters.

    Returns:
        (..., 3) points in the camera frame, meters.
    """
    xp = namespace(uv)
    x = (uv[..., 0] - intrinsics[..., 2]) / intrinsics[..., 0] * depth
    y = (uv[..., 1] - intrinsics[..., 3]) / intrinsics[..., 1] * depth
    return xp.stack((x, y, depth + 0.0 * x), axis=-1)


def world_to_camera(world_T_cam: Array, point_world: Array) -> Array:
    """Express world points in the camera frame: ``R^T (p - c)``.

    Args:
        world_T_cam: (..., 4, 4) camera poses.
        point_world: (..., 3) world points, meters.

    Returns:
        (..., 3) camera-frame points, meters.
    """
    xp = namespace(point_world)
    d = point_world - world_T_cam[..., :3, 3]
    rotation = world_T_cam[..., :3, :3]
    return xp.einsum("...ji,...j->...i", rotation, d)


def camera_to_world(world_T_cam: Array, point_cam: Array) -> Array:
    """Express camera-frame points in the world: ``R x + c``. Shapes as in :func:`world_to_camera`."""
    xp = namespace(point_cam)
    rotation = world_T_cam[..., :3, :3]
    return xp.einsum("...ij,...j->...i", rotation, point_cam) + world_T_cam[..., :3, 3]


def seen_from(world_T_cam: FloatArray, frame: IntArray, points: FloatArray) -> FloatArray:
    """Return world points (N, 3) in the axes of their camera ``frame`` (N,), of poses (T, 4, 4).

    Entry by entry: a pose per point is more memory than all that is computed with it.
    """
    d = [points[:, j] - world_T_cam[:, j, 3][frame] for j in range(3)]
    out = np.empty((len(points), 3))
    for i in range(3):
        out[:, i] = sum(world_T_cam[:, j, i][frame] * d[j] for j in range(3))
    return out


def lifted_from(world_T_cam: FloatArray, frame: IntArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) in the axes of their camera ``frame`` (N,) in the world: undo :func:`seen_from`."""
    out = np.empty((len(points), 3))
    for i in range(3):
        out[:, i] = sum(world_T_cam[:, i, j][frame] * points[:, j] for j in range(3)) + world_T_cam[:, i, 3][frame]
    return out
