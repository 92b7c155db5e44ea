r"""Priors that anchor what the images leave free.

intrinsics   r = K - K_0                                [px], 4-vector
log-scale    r = s_t - s_0                              [dimensionless], 1-vector
deviation    r = s_t - s                                [dimensionless], 1-vector: of a frame's log-scale from that
which all frames share, where other measurements than the cue know lengths
aspect       r = log(fx / fy) - log(fx_0 / fy_0)        [dimensionless], 1-vector: the shape of a pixel
scale        r = log(|c_a - c_b| / distance)            [dimensionless], 1-vector: fixes the scale of a
reconstruction that no depth prior holds
common       r = s_t - c                                [dimensionless], 1-vector: frames have one scale, of any size
gravity      r = |g| - magnitude                        [m/s^2], 1-vector; no direction is preferred
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import NativeRow, factor
from uni4d_fg.factors.variable_types import (
    CALIBRATION_COLUMNS,
    CUE_SCALE,
    GRAVITY,
    INTRINSICS,
    LOG_SCALE,
    POSE,
    calibration,
)

_MIN_DISTANCE = 1e-9
_LOOSE = 1e9
"""Sigma of the skew, which ours leaves alone."""


def difference_jacobian(variable: FloatArray, *, measured: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian, the identity (N, d, d)."""
    n, d = variable.shape
    return variable - measured, [np.broadcast_to(np.eye(d), (n, d, d))]


def native_intrinsics(row: NativeRow) -> Any:
    """Return GTSAM's prior on a pinhole, with a loose skew."""
    if row.is_robust:  # a kernel would see the skew's entry as well
        return None
    sigma = np.full(5, _LOOSE)
    sigma[list(CALIBRATION_COLUMNS)] = row.noise.sigmas()
    return gtsam.PriorFactorCal3_S2(
        row.keys[0], calibration(row.data["measured"]), gtsam.noiseModel.Diagonal.Sigmas(sigma)
    )


def native_log_scale(row: NativeRow) -> Any:
    """Return GTSAM's prior on a vector."""
    return gtsam.PriorFactorVector(row.keys[0], row.data["measured"], row.noise)


@factor(INTRINSICS, data={"measured": 4}, dim=4, native=native_intrinsics)
def intrinsics_prior(intrinsics: Array, *, measured: Array) -> Array:
    """Return intrinsics - measured, (N, 4) px."""
    return intrinsics - measured


@factor(LOG_SCALE, data={"measured": 1}, dim=1, native=native_log_scale)
def log_scale_prior(log_scale: Array, *, measured: Array) -> Array:
    """Return log_scale - measured, (N, 1)."""
    return log_scale - measured


intrinsics_prior.jacobian(difference_jacobian)
log_scale_prior.jacobian(difference_jacobian)


@factor(CUE_SCALE, data={"measured": 1}, dim=1, native=native_log_scale)
def cue_scale_prior(cue_scale: Array, *, measured: Array) -> Array:
    """Return cue_scale - measured, (N, 1)."""
    return cue_scale - measured


cue_scale_prior.jacobian(difference_jacobian)


@factor(LOG_SCALE, CUE_SCALE, dim=1)
def log_scale_deviation(log_scale: Array, cue_scale: Array) -> Array:
    """Return log_scale - cue_scale, (N, 1)."""
    return log_scale - cue_scale


@log_scale_deviation.jacobian
def log_scale_deviation_jacobian(log_scale: FloatArray, cue_scale: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians (N, 1, 1)."""
    one = np.ones((len(log_scale), 1, 1))
    return log_scale - cue_scale, [one, -one]


@factor(POSE, POSE, data={"distance": ()}, dim=1)
def scale_anchor(first: Array, second: Array, *, distance: Array) -> Array:
    """Return (N, 1) of two poses (N, 4, 4) and the distance of their centers (N,), m."""
    xp = namespace(first)
    d = second[..., :3, 3] - first[..., :3, 3]
    length = xp.sqrt(xp.sum(d * d, axis=-1) + _MIN_DISTANCE**2)
    return xp.log(length / distance)[..., None]


@scale_anchor.jacobian
def scale_anchor_jacobian(
    first: FloatArray, second: FloatArray, *, distance: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of both poses, each (N, 1, 6)."""
    d = second[:, :3, 3] - first[:, :3, 3]
    squared = np.sum(d * d, axis=-1) + _MIN_DISTANCE**2
    by_center = (d / squared[:, None])[:, None, :]
    jacobians = [np.zeros((len(d), 1, 6)) for _ in range(2)]
    jacobians[0][:, :, 3:] = -by_center @ first[:, :3, :3]
    jacobians[1][:, :, 3:] = by_center @ second[:, :3, :3]
    return (0.5 * np.log(squared) - np.log(distance))[:, None], jacobians


@factor(INTRINSICS, data={"measured": ()}, dim=1)
def aspect_prior(intrinsics: Array, *, measured: Array) -> Array:
    """Return (N, 1) of intrinsics (N, 4) and the measured log(fx / fy) (N,)."""
    xp = namespace(intrinsics)
    return (xp.log(intrinsics[..., 0]) - xp.log(intrinsics[..., 1]) - measured)[..., None]


@aspect_prior.jacobian
def aspect_prior_jacobian(intrinsics: FloatArray, *, measured: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian (N, 1, 4)."""
    jacobian = np.zeros((len(intrinsics), 1, 4))
    jacobian[:, 0, 0] = 1.0 / intrinsics[:, 0]
    jacobian[:, 0, 1] = -1.0 / intrinsics[:, 1]
    return aspect_prior.residual(intrinsics, measured=measured), [jacobian]


@factor(GRAVITY, data={"magnitude": ()}, dim=1)
def gravity_magnitude(gravity: Array, *, magnitude: Array) -> Array:
    """Return (N, 1) of gravity (N, 3) and its known magnitude (N,), m/s^2."""
    xp = namespace(gravity)
    return (xp.sqrt(xp.sum(gravity * gravity, axis=-1) + _MIN_DISTANCE**2) - magnitude)[..., None]


@gravity_magnitude.jacobian
def gravity_magnitude_jacobian(gravity: FloatArray, *, magnitude: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian (N, 1, 3)."""
    length = np.sqrt(np.sum(gravity * gravity, axis=-1) + _MIN_DISTANCE**2)
    return (length - magnitude)[:, None], [(gravity / length[:, None])[:, None, :]]
