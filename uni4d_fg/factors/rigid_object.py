r"""A rigid object: points that are fixed in its frame, one pose per frame, seen by frozen cameras.

    p = R_o q + t_o,    x = R_c^T (p - c)

    reprojection   r = z_{k,t} - pi_K(x)                                    [px], 2-vector
    depth prior    r = log(x_z) - log(D_t(z_{k,t})) - s_t                   [dimensionless], 1-vector
    smoothness     r = Log(T_t^{-1} T_{t+1}) - Log(T_{t-1}^{-1} T_t)        [rad and m per frame^2], 6-vector

Variables: T_t = (R_o, t_o) = world_T_object[t] (``OBJECT_POSE``) and q_k (``OBJECT_POINT``, in the object's frame).
Data: the pixel ``uv``, the depth cue ``depth`` and the frozen ``world_T_cam``, ``intrinsics`` and ``log_scale``. The
tangent of a pose is the body-frame twist xi = (omega, v), T Exp(xi); with a the derivative of a residual by p

    dr/dxi = a [-R_o skew(q), R_o],    dr/dq = a R_o

Smoothness compares the body-frame twists of two successive steps: it vanishes for a constant screw motion, whatever
the object's frame. With A = T_{t-1}^{-1} T_t and B = T_t^{-1} T_{t+1},

    dr/dxi_{t-1} = J_l^{-1}(A),    dr/dxi_t = -J_r^{-1}(A) - J_l^{-1}(B),    dr/dxi_{t+1} = J_r^{-1}(B)

J_r^{-1} and J_l^{-1} are the inverse right and left Jacobians of SE(3) at the logarithms. Log is smooth up to a half
turn between two frames, where the axis is undetermined; exactly there the rotation is taken for none, and everything
stays finite. Sources: points in the object's own frame and smoothness of its body-frame motion are usual in object
SLAM (DynaSLAM II, Bescos et al. 2021; DynoSAM, Morris et al. 2025); the Jacobians are those of Barfoot 2017, chapter 7.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.depth_prior import dynamic_depth_prior
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import OBJECT_POINT, OBJECT_POSE
from uni4d_fg.geometry.camera import camera_to_world
from uni4d_fg.geometry.se3 import inverse_right_jacobian, relative_twist


@factor(OBJECT_POSE, OBJECT_POINT, data=dynamic_reprojection.data, dim=2, stack=1)
def rigid_reprojection(
    world_T_object: Array, object_point: Array, *, uv: Array, world_T_cam: Array, intrinsics: Array
) -> Array:
    """Return (N, 2) px of object poses (N, 4, 4), points in the object (N, 3), pixels (N, 2) and frozen cameras."""
    point = camera_to_world(world_T_object, object_point)
    return dynamic_reprojection.residual(point, uv=uv, world_T_cam=world_T_cam, intrinsics=intrinsics)


@rigid_reprojection.jacobian
def rigid_reprojection_jacobian(
    world_T_object: FloatArray, object_point: FloatArray, **data: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and Jacobians: object pose (N, 2, 6), point in the object (N, 2, 3)."""
    r, (by_point,) = dynamic_reprojection.linearize(camera_to_world(world_T_object, object_point), **data)
    return r, _chain_to_object(by_point, world_T_object, object_point)


@factor(OBJECT_POSE, OBJECT_POINT, data=dynamic_depth_prior.data, dim=1, stack=1)
def rigid_depth_prior(
    world_T_object: Array, object_point: Array, *, depth: Array, world_T_cam: Array, log_scale: Array
) -> Array:
    """Return (N, 1) of object poses (N, 4, 4), points in the object (N, 3), cue depths (N,) and frozen cameras."""
    point = camera_to_world(world_T_object, object_point)
    return dynamic_depth_prior.residual(point, depth=depth, world_T_cam=world_T_cam, log_scale=log_scale)


@rigid_depth_prior.jacobian
def rigid_depth_prior_jacobian(
    world_T_object: FloatArray, object_point: FloatArray, **data: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and Jacobians: object pose (N, 1, 6), point in the object (N, 1, 3)."""
    r, (by_point,) = dynamic_depth_prior.linearize(camera_to_world(world_T_object, object_point), **data)
    return r, _chain_to_object(by_point, world_T_object, object_point)


def _chain_to_object(by_point: FloatArray, world_T_object: FloatArray, q: FloatArray) -> list[FloatArray]:
    """Chain dr/dp (N, d, 3) to the object's pose (N, d, 6) and to the point in its frame (N, d, 3)."""
    by_object_point = by_point @ world_T_object[:, :3, :3]
    by_rotation = np.cross(q[:, None, :], by_object_point)  # = -by_object_point . skew(q)
    return [np.concatenate([by_rotation, by_object_point], axis=2), by_object_point]


@factor(OBJECT_POSE, OBJECT_POSE, OBJECT_POSE, dim=6, stack=0)
def rigid_smoothness(before: Array, now: Array, after: Array) -> Array:
    """Return (N, 6), rad and m per frame^2, of three successive object poses (N, 4, 4)."""
    return relative_twist(now, after) - relative_twist(before, now)


@rigid_smoothness.jacobian
def rigid_smoothness_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 6, 6)."""
    a, b = relative_twist(before, now), relative_twist(now, after)
    by_now = -inverse_right_jacobian(a) - inverse_right_jacobian(-b)
    return b - a, [inverse_right_jacobian(-a), by_now, inverse_right_jacobian(b)]
