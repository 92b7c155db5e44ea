r"""Priors on cameras with a lens: intrinsics and distortion parameters, and the shape of a pixel.

r = (camera - camera_0, log(fx / fy) - log_aspect)      [px (4), dimensionless (5)], 9-vector
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import FISHEYE_CAMERA, OPENCV_CAMERA


def residual(camera: Array, measured: Array, log_aspect: Array) -> Array:
    """Return (N, 9) of cameras (N, 8), their prior values (N, 8) and those of log(fx / fy) (N,)."""
    xp = namespace(camera)
    aspect = xp.log(camera[..., 0] / camera[..., 1]) - log_aspect
    return xp.concat((camera - measured, aspect[..., None]), axis=-1)


@factor(OPENCV_CAMERA, data={"measured": 8, "log_aspect": ()}, dim=9, term="intrinsics_prior")
def opencv_camera_prior(camera: Array, *, measured: Array, log_aspect: Array) -> Array:
    """Return (N, 9), see :func:`residual`."""
    return residual(camera, measured, log_aspect)


@factor(FISHEYE_CAMERA, data={"measured": 8, "log_aspect": ()}, dim=9, term="intrinsics_prior")
def fisheye_camera_prior(camera: Array, *, measured: Array, log_aspect: Array) -> Array:
    """Return (N, 9), see :func:`residual`."""
    return residual(camera, measured, log_aspect)


@opencv_camera_prior.jacobian
@fisheye_camera_prior.jacobian
def linearize(
    camera: FloatArray, *, measured: FloatArray, log_aspect: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian (N, 9, 8)."""
    jacobian = np.zeros((len(camera), 9, 8))
    jacobian[:, :8] = np.eye(8)
    jacobian[:, 8, 0], jacobian[:, 8, 1] = 1.0 / camera[:, 0], -1.0 / camera[:, 1]
    return residual(camera, measured, log_aspect), [jacobian]
