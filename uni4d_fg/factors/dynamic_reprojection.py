r"""Dynamic reprojection, E_NR: a point of one frame seen by that frame's camera.

    r = z_{k,t} - pi_K(p_{k,t}, xi_t)    [px], 2-vector

Variable: p_{k,t} (``dynamic_point``, world). Data: the pixel ``uv``, the frozen pose ``world_T_cam`` and
the frozen ``intrinsics``. The second type has pose and intrinsics as variables: the formula is then that of
a landmark. Source: Uni4D, non-rigid bundle adjustment term.
"""

from __future__ import annotations

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.projection import chain_to_world_point, projection_derivatives
from uni4d_fg.factors.static_reprojection import native as native_projection
from uni4d_fg.factors.static_reprojection import static_reprojection, static_reprojection_jacobian
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, POSE
from uni4d_fg.geometry.camera import project, world_to_camera


@factor(DYNAMIC_POINT, data={"uv": 2, "world_T_cam": (4, 4), "intrinsics": 4}, dim=2, stack=0)
def dynamic_reprojection(dynamic_point: Array, *, uv: Array, world_T_cam: Array, intrinsics: Array) -> Array:
    """Return (N, 2) px of points (N, 3), pixels (N, 2), poses (N, 4, 4) and intrinsics (N, 4)."""
    return uv - project(intrinsics, world_to_camera(world_T_cam, dynamic_point))


@dynamic_reprojection.jacobian
def dynamic_reprojection_jacobian(
    dynamic_point: FloatArray, *, uv: FloatArray, world_T_cam: FloatArray, intrinsics: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian with respect to the point, (N, 2, 3)."""
    x = world_to_camera(world_T_cam, dynamic_point)
    by_x, _ = projection_derivatives(intrinsics, x)
    return uv - project(intrinsics, x), [-chain_to_world_point(by_x, world_T_cam)]


@factor(
    POSE, DYNAMIC_POINT, INTRINSICS,
    data={"uv": 2}, dim=2, term=dynamic_reprojection.term, stack=1, native=native_projection,
)  # fmt: skip
def joint_dynamic_reprojection(world_T_cam: Array, dynamic_point: Array, intrinsics: Array, *, uv: Array) -> Array:
    """Return (N, 2) px of poses (N, 4, 4), points (N, 3), intrinsics (N, 4) and pixels (N, 2)."""
    return static_reprojection.residual(world_T_cam, dynamic_point, intrinsics, uv=uv)


joint_dynamic_reprojection.jacobian(static_reprojection_jacobian)
