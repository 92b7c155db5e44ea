r"""Static reprojection, E_BA: a landmark seen by a camera with shared intrinsics.

    r = z_{k,t} - pi_K(p_k, xi_t)        [px], 2-vector
    x = R_t^T (p_k - c_t),  pi_K(x) = (fx x g(z) + cx, fy y g(z) + cy)

z_{k,t} is the observed pixel ``uv``, xi_t = (R_t, c_t) the pose ``world_T_cam``, p_k the ``landmark`` in
the world, K the ``intrinsics``; g is 1/z in front of the camera (see :mod:`uni4d_fg.geometry.camera`).
Source: Uni4D, static bundle adjustment term.
"""

from __future__ import annotations

from typing import Any

import gtsam

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import NativeRow, factor
from uni4d_fg.factors.projection import chain_to_pose, chain_to_world_point, projection_derivatives
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry.camera import project, world_to_camera


def native(row: NativeRow) -> Any:
    """Return GTSAM's projection factor; it differs behind the camera, where its error has no gradient."""
    pose, landmark, intrinsics = row.keys
    return gtsam.GeneralSFMFactor2Cal3_S2(row.data["uv"], row.noise, pose, landmark, intrinsics)


@factor(POSE, LANDMARK, INTRINSICS, data={"uv": 2}, dim=2, stack=1, native=native)
def static_reprojection(world_T_cam: Array, landmark: Array, intrinsics: Array, *, uv: Array) -> Array:
    """Return (N, 2) px of poses (N, 4, 4), landmarks (N, 3), intrinsics (N, 4) and pixels (N, 2)."""
    return uv - project(intrinsics, world_to_camera(world_T_cam, landmark))


@static_reprojection.jacobian
def static_reprojection_jacobian(
    world_T_cam: FloatArray, landmark: FloatArray, intrinsics: FloatArray, *, uv: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians: pose (N, 2, 6), landmark (N, 2, 3), intrinsics (N, 2, 4)."""
    x = world_to_camera(world_T_cam, landmark)
    by_x, by_intrinsics = projection_derivatives(intrinsics, x)
    pose, point = chain_to_pose(by_x, x), chain_to_world_point(by_x, world_T_cam)
    return uv - project(intrinsics, x), [-pose, -point, -by_intrinsics]
