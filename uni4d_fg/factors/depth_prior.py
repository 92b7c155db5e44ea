r"""Depth prior: a point's depth agrees with the depth cue up to one log-scale per frame.

    r = log(z) - log(D_t(z_{k,t})) - s_t,   z = e_z^T R_t^T (p - c_t)        [dimensionless], 1-vector

``depth`` is the cue at the observation (meters), ``log_scale`` the frame's s_t: the cue is too small by the
factor exp(s_t). Below the near plane log is continued by its tangent, so that a point behind the camera is
pushed forward. Three types: on pose, landmark and log-scale (stage 2), on a dynamic point with frozen camera
and log-scale (stage 3), and on pose, dynamic point and log-scale (joint energy). Not in the paper: without it
the scene may shrink towards the camera at no cost.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry.camera import NEAR_PLANE, world_to_camera


def log_depth(z: Array) -> Array:
    """Return log(z), continued below the near plane by its tangent; any shape."""
    xp = namespace(z)
    safe = xp.where(z >= NEAR_PLANE, z, NEAR_PLANE + 0.0 * z)
    return xp.log(safe) + xp.where(z >= NEAR_PLANE, 0.0 * z, z / NEAR_PLANE - 1.0)


@factor(POSE, LANDMARK, LOG_SCALE, data={"depth": ()}, dim=1, term="depth_prior", stack=1)
def static_depth_prior(world_T_cam: Array, landmark: Array, log_scale: Array, *, depth: Array) -> Array:
    """Return (N, 1) of poses (N, 4, 4), landmarks (N, 3), log-scales (N, 1) and cue depths (N,)."""
    xp = namespace(landmark)
    z = world_to_camera(world_T_cam, landmark)[..., 2]
    return (log_depth(z) - xp.log(depth))[..., None] - log_scale


@static_depth_prior.jacobian
def static_depth_prior_jacobian(
    world_T_cam: FloatArray, landmark: FloatArray, log_scale: FloatArray, *, depth: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and Jacobians: pose (N, 1, 6), landmark (N, 1, 3), log-scale (N, 1, 1)."""
    x = world_to_camera(world_T_cam, landmark)
    slope = 1.0 / np.maximum(x[:, 2], NEAR_PLANE)
    pose = np.zeros((len(x), 1, 6))
    pose[:, 0, 0] = -x[:, 1] * slope
    pose[:, 0, 1] = x[:, 0] * slope
    pose[:, 0, 5] = -slope
    point = (world_T_cam[:, :3, 2] * slope[:, None])[:, None, :]
    r = (log_depth(x[:, 2]) - np.log(depth))[:, None] - log_scale
    return r, [pose, point, np.full((len(x), 1, 1), -1.0)]


@factor(DYNAMIC_POINT, data={"depth": (), "world_T_cam": (4, 4), "log_scale": ()}, dim=1, term="depth_prior", stack=0)
def dynamic_depth_prior(dynamic_point: Array, *, depth: Array, world_T_cam: Array, log_scale: Array) -> Array:
    """Return (N, 1) of points (N, 3), cue depths (N,), frozen poses (N, 4, 4) and log-scales (N,)."""
    return static_depth_prior.residual(world_T_cam, dynamic_point, log_scale[..., None], depth=depth)


@dynamic_depth_prior.jacobian
def dynamic_depth_prior_jacobian(
    dynamic_point: FloatArray, *, depth: FloatArray, world_T_cam: FloatArray, log_scale: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian with respect to the point, (N, 1, 3)."""
    r, (_, point, _) = static_depth_prior_jacobian(world_T_cam, dynamic_point, log_scale[:, None], depth=depth)
    return r, [point]


@factor(POSE, DYNAMIC_POINT, LOG_SCALE, data={"depth": ()}, dim=1, term="depth_prior", stack=1)
def joint_dynamic_depth_prior(world_T_cam: Array, dynamic_point: Array, log_scale: Array, *, depth: Array) -> Array:
    """Return (N, 1) of poses (N, 4, 4), points (N, 3), log-scales (N, 1) and cue depths (N,)."""
    return static_depth_prior.residual(world_T_cam, dynamic_point, log_scale, depth=depth)


joint_dynamic_depth_prior.jacobian(static_depth_prior_jacobian)
