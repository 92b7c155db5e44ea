r"""Reprojection through a lens: E_BA with the distortion parameters as variables.

    r = z_{k,t} - (fx a + cx, fy b + cy),   (a, b) = lens(R_t^T (p_k - c_t))     [px], 2-vector

The camera is one variable of eight entries: fx, fy, cx, cy and the four parameters of its family (see
:mod:`uni4d_fg.geometry.lens`), of which SIMPLE_RADIAL and RADIAL hold some at zero. GTSAM's equals are
``GeneralSFMFactor2Cal3DS2`` and ``GeneralSFMFactor2Cal3Fisheye``. Behind the camera the polynomial family continues the
inverse depth as the pinhole does; the fisheye needs no such policy.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import NativeRow, factor
from uni4d_fg.factors.projection import projection_derivatives
from uni4d_fg.factors.variable_types import FISHEYE_CAMERA, LANDMARK, OPENCV_CAMERA, POSE
from uni4d_fg.geometry.camera import inverse_depth, world_to_camera
from uni4d_fg.geometry.lens import distort, distort_derivatives, fisheye, fisheye_derivatives


def native_opencv(row: NativeRow) -> Any:
    """Return GTSAM's projection factor; it differs behind the camera."""
    pose, landmark, camera = row.keys
    return gtsam.GeneralSFMFactor2Cal3DS2(row.data["uv"], row.noise, pose, landmark, camera)


def native_fisheye(row: NativeRow) -> Any:
    """Return GTSAM's projection factor; it refuses points behind the camera."""
    pose, landmark, camera = row.keys
    return gtsam.GeneralSFMFactor2Cal3Fisheye(row.data["uv"], row.noise, pose, landmark, camera)


@factor(POSE, LANDMARK, OPENCV_CAMERA, data={"uv": 2}, dim=2, term="static_reprojection", stack=1, native=native_opencv)
def opencv_reprojection(world_T_cam: Array, landmark: Array, camera: Array, *, uv: Array) -> Array:
    """Return (N, 2) px of poses (N, 4, 4), landmarks (N, 3), cameras (N, 8) and real pixels (N, 2)."""
    return uv - _pixels(camera, distort(camera[..., 4:], _in_plane(world_to_camera(world_T_cam, landmark))))


@factor(
    POSE, LANDMARK, FISHEYE_CAMERA, data={"uv": 2}, dim=2, term="static_reprojection", stack=1, native=native_fisheye
)
def fisheye_reprojection(world_T_cam: Array, landmark: Array, camera: Array, *, uv: Array) -> Array:
    """Return (N, 2) px of poses (N, 4, 4), landmarks (N, 3), cameras (N, 8) and real pixels (N, 2)."""
    return uv - _pixels(camera, fisheye(camera[..., 4:], world_to_camera(world_T_cam, landmark)))


@opencv_reprojection.jacobian
def opencv_jacobian(
    world_T_cam: FloatArray, landmark: FloatArray, camera: FloatArray, *, uv: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians: pose (N, 2, 6), landmark (N, 2, 3), camera (N, 2, 8)."""
    x = world_to_camera(world_T_cam, landmark)
    plane = _in_plane(x)
    bent = distort(camera[:, 4:], plane)
    by_plane, by_parameters = distort_derivatives(camera[:, 4:], plane)
    unit = np.broadcast_to(np.array([1.0, 1.0, 0.0, 0.0]), (len(x), 4))
    by_x = by_plane @ projection_derivatives(unit, x)[0]
    return uv - _pixels(camera, bent), _jacobians(world_T_cam, x, camera, bent, by_x, by_parameters)


@fisheye_reprojection.jacobian
def fisheye_jacobian(
    world_T_cam: FloatArray, landmark: FloatArray, camera: FloatArray, *, uv: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians: pose (N, 2, 6), landmark (N, 2, 3), camera (N, 2, 8)."""
    x = world_to_camera(world_T_cam, landmark)
    bent = fisheye(camera[:, 4:], x)
    by_x, by_parameters = fisheye_derivatives(camera[:, 4:], x)
    return uv - _pixels(camera, bent), _jacobians(world_T_cam, x, camera, bent, by_x, by_parameters)


def _in_plane(x: Array) -> Array:
    """Return (N, 2) x / z, y / z, continued behind the near plane."""
    xp = namespace(x)
    g = inverse_depth(x[..., 2])
    return xp.stack((x[..., 0] * g, x[..., 1] * g), axis=-1)


def _pixels(camera: Array, bent: Array) -> Array:
    return camera[..., :2] * bent + camera[..., 2:4]


def _jacobians(
    world_T_cam: FloatArray,
    x: FloatArray,
    camera: FloatArray,
    bent: FloatArray,
    by_x: FloatArray,
    by_parameters: FloatArray,
) -> list[FloatArray]:
    """Chain d (a, b) / d x (N, 2, 3) to the variables."""
    focal = camera[:, :2, None]
    by_x = focal * by_x
    # x = R^T (p - c): d x / d (omega, v) = [skew(x), -I], and row . skew(x) = row cross x
    pose = np.concatenate([-np.cross(by_x, x[:, None, :]), by_x], axis=2)
    point = -by_x @ np.swapaxes(world_T_cam[:, :3, :3], 1, 2)
    by_camera = np.zeros((len(x), 2, 8))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = -bent[:, 0], -bent[:, 1]
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = -1.0
    by_camera[:, :, 4:] = -focal * by_parameters
    return [pose, point, by_camera]
