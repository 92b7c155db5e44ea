r"""Relative camera motion over three poses, E_cam = E_rot + E_trans.

    r = (a - b) / ((|a|_f + |b|_f) / 2),   |v|_f = sqrt(|v|^2 + floor^2)      [dimensionless], 3-vectors

    translation   a = c_t - c_{t-1},               b = c_{t+1} - c_t               (world axes, m)
    rotation      a = Log(R_{t-1}^T R_t),          b = Log(R_t^T R_{t+1})          (rad)

The change of the relative motion, relative to its size: 0 for constant velocity, at most 2. ``floor`` (m or
rad) guards the denominator: for a camera at rest the paper's ratio is 0/0, this one is 0 with a finite
Jacobian. Variables: the poses of frames t-1, t, t+1. The rotation's logarithm is singular for a half turn
between two frames, which video does not have. Source: Uni4D, camera motion term (vector form).
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.geometry.se3 import skew


def rotation_log(rotation: Array) -> Array:
    """Return rotation vectors (N, 3), rad, of matrices (N, 3, 3), differentiable at the identity."""
    xp = namespace(rotation)
    axis = 0.5 * xp.stack(
        (
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ),
        axis=-1,
    )
    squared_sine = xp.sum(axis * axis, axis=-1)
    small = squared_sine < 1e-14
    sine = xp.sqrt(xp.where(small, 1.0 + 0.0 * squared_sine, squared_sine))
    cosine = 0.5 * (rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2] - 1.0)
    factor = xp.where(small, 1.0 + squared_sine / 6.0, xp.atan2(sine, cosine) / sine)
    return factor[..., None] * axis


def _relative_rotation(first: Array, second: Array) -> Array:
    """Return R_first^T R_second, (N, 3, 3)."""
    a, b = first[..., :3, :3], second[..., :3, :3]
    xp = namespace(a)
    return xp.sum(a[..., :, :, None] * b[..., :, None, :], axis=-3)


def _relative_change(a: Array, b: Array, floor: Array) -> Array:
    xp = namespace(a)
    norm_a = xp.sqrt(xp.sum(a * a, axis=-1) + floor**2)
    norm_b = xp.sqrt(xp.sum(b * b, axis=-1) + floor**2)
    return (a - b) / (0.5 * (norm_a + norm_b))[..., None]


def rotation_residual(before: Array, now: Array, after: Array, *, floor: Array) -> Array:
    """Return (N, 3) of three poses (N, 4, 4) and the floor (N,), rad."""
    a = rotation_log(_relative_rotation(before, now))
    b = rotation_log(_relative_rotation(now, after))
    return _relative_change(a, b, floor)


def translation_residual(before: Array, now: Array, after: Array, *, floor: Array) -> Array:
    """Return (N, 3) of three poses (N, 4, 4) and the floor (N,), m."""
    a = now[..., :3, 3] - before[..., :3, 3]
    b = after[..., :3, 3] - now[..., :3, 3]
    return _relative_change(a, b, floor)


def _relative_change_derivatives(
    a: FloatArray, b: FloatArray, floor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r (N, 3), d r / d a and d r / d b, each (N, 3, 3)."""
    norm_a = np.sqrt(np.sum(a * a, axis=-1) + floor**2)
    norm_b = np.sqrt(np.sum(b * b, axis=-1) + floor**2)
    mean = 0.5 * (norm_a + norm_b)
    r: FloatArray = (a - b) / mean[:, None]
    identity = np.eye(3) / mean[:, None, None]
    by_a = identity - r[:, :, None] * (0.5 * a / (norm_a * mean)[:, None])[:, None, :]
    by_b = -identity - r[:, :, None] * (0.5 * b / (norm_b * mean)[:, None])[:, None, :]
    return r, by_a, by_b


def _inverse_right_jacobian(omega: FloatArray) -> FloatArray:
    """Return Jr^{-1} with Log(Exp(omega) Exp(d)) = omega + Jr^{-1} d, (N, 3, 3)."""
    angle = np.linalg.norm(omega, axis=-1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    coefficient = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    w = skew(omega)
    result: FloatArray = np.eye(3) + 0.5 * w + coefficient[:, None, None] * (w @ w)
    return result


def rotation_linearize(
    before: FloatArray, now: FloatArray, after: FloatArray, *, floor: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a = rotation_log(_relative_rotation(before, now))
    b = rotation_log(_relative_rotation(now, after))
    r, by_a, by_b = _relative_change_derivatives(a, b, floor)
    right_a, right_b = _inverse_right_jacobian(a), _inverse_right_jacobian(b)
    # The left Jacobian's inverse is the transpose of the right one's.
    left_a, left_b = np.swapaxes(right_a, 1, 2), np.swapaxes(right_b, 1, 2)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    jacobians[0][:, :, :3] = -by_a @ left_a
    jacobians[1][:, :, :3] = by_a @ right_a - by_b @ left_b
    jacobians[2][:, :, :3] = by_b @ right_b
    return r, jacobians


def translation_linearize(
    before: FloatArray, now: FloatArray, after: FloatArray, *, floor: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a = now[:, :3, 3] - before[:, :3, 3]
    b = after[:, :3, 3] - now[:, :3, 3]
    r, by_a, by_b = _relative_change_derivatives(a, b, floor)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    jacobians[0][:, :, 3:] = -by_a @ before[:, :3, :3]
    jacobians[1][:, :, 3:] = (by_a - by_b) @ now[:, :3, :3]
    jacobians[2][:, :, 3:] = by_b @ after[:, :3, :3]
    return r, jacobians


CAMERA_ROTATION = FactorFamily(
    name="camera_rotation",
    variables=("pose",) * 3,
    data=("floor",),
    residual_dim=3,
    residual=rotation_residual,
    linearize=rotation_linearize,
)

CAMERA_TRANSLATION = FactorFamily(
    name="camera_translation",
    variables=("pose",) * 3,
    data=("floor",),
    residual_dim=3,
    residual=translation_residual,
    linearize=translation_linearize,
)
