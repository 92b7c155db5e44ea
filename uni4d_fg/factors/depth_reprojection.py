r"""Depth reprojection of a frame pair, the energy of camera initialization.

    r = z_{k,j} - pi_K( R_j^T ( R_i x_i + c_i - c_j ) ),   x_i = pi_K^{-1}(z_{k,i}, D_i(z_{k,i}))   [px]

The pixel ``uv_source`` of frame i is lifted with its ``depth`` cue (meters, taken as truth here), moved by
the two poses and compared with the pixel ``uv_target`` of the same track in frame j. Variables: both poses
and the shared intrinsics, which act twice (lifting and projecting). Source: Uni4D, camera initialization.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.projection import chain_to_pose, chain_to_world_point, projection_derivatives
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera


@factor(POSE, POSE, INTRINSICS, data={"uv_source": 2, "depth": (), "uv_target": 2}, dim=2, stack=(0, 1))
def depth_reprojection(
    source_pose: Array,
    target_pose: Array,
    intrinsics: Array,
    *,
    uv_source: Array,
    depth: Array,
    uv_target: Array,
) -> Array:
    """Return (N, 2) px of poses (N, 4, 4) twice, intrinsics (N, 4), pixels (N, 2), depth (N,), pixels (N, 2)."""
    point_world = camera_to_world(source_pose, unproject(intrinsics, uv_source, depth))
    return uv_target - project(intrinsics, world_to_camera(target_pose, point_world))


@depth_reprojection.jacobian
def depth_reprojection_jacobian(
    source_pose: FloatArray,
    target_pose: FloatArray,
    intrinsics: FloatArray,
    *,
    uv_source: FloatArray,
    depth: FloatArray,
    uv_target: FloatArray,
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and Jacobians: source pose (N, 2, 6), target pose (N, 2, 6), intrinsics (N, 2, 4)."""
    x_source = unproject(intrinsics, uv_source, depth)
    x_target = world_to_camera(target_pose, camera_to_world(source_pose, x_source))
    by_x, by_intrinsics = projection_derivatives(intrinsics, x_target)
    target = chain_to_pose(by_x, x_target)
    # d uv / d x_source = d uv/d x_target . R_j^T . R_i
    by_source = chain_to_world_point(by_x, target_pose) @ source_pose[:, :3, :3]
    source = np.empty_like(target)
    source[:, :, :3] = np.cross(x_source[:, None, :], by_source)  # = -by_source . skew(x_source)
    source[:, :, 3:] = by_source
    fx, fy = intrinsics[:, 0, None], intrinsics[:, 1, None]
    by_intrinsics[:, :, 0] -= by_source[:, :, 0] * (x_source[:, 0, None] / fx)
    by_intrinsics[:, :, 1] -= by_source[:, :, 1] * (x_source[:, 1, None] / fy)
    by_intrinsics[:, :, 2] -= by_source[:, :, 0] * (depth[:, None] / fx)
    by_intrinsics[:, :, 3] -= by_source[:, :, 1] * (depth[:, None] / fy)
    return uv_target - project(intrinsics, x_target), [-source, -target, -by_intrinsics]
