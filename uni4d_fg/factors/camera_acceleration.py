r"""Acceleration of the camera over three frames, in time units.

    linear    r = 2 (v2 - v1) / (h1 + h2),   v1 = (c_t - c_{t-1}) / h1,      v2 = (c_{t+1} - c_t) / h2       [m/s^2]
    angular   r = 2 (w2 - w1) / (h1 + h2),   w1 = Log(R_{t-1}^T R_t) / h1,   w2 = Log(R_t^T R_{t+1}) / h2  [rad/s^2]

c is the camera's center in the world, w the angular velocity in the camera's axes, h1 and h2 (s) the times from frame
t-1 to t and from t to t+1, which need not be equal. r is the second derivative to first order in h, to second order
for equal times. Variables: the poses of frames t-1, t, t+1. The rotation's logarithm is singular for a half turn
between two frames, which video does not have. Source: the white-noise-on-acceleration prior of continuous-time
estimation (Barfoot 2017, "State estimation for robotics", section 11.1), as finite differences.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.geometry.se3 import relative_rotation, rotation_log, so3_inverse_right_jacobian


def _second_difference(a: Array, b: Array, before: Array, after: Array) -> Array:
    return (2.0 / (before + after))[..., None] * (b / after[..., None] - a / before[..., None])


@factor(POSE, POSE, POSE, data={"seconds_before": (), "seconds_after": ()}, dim=3)
def camera_angular_acceleration(
    before: Array, now: Array, after: Array, *, seconds_before: Array, seconds_after: Array
) -> Array:
    """Return (N, 3) rad/s^2 of three poses (N, 4, 4) and the times between them (N,), s."""
    a = rotation_log(relative_rotation(before, now))
    b = rotation_log(relative_rotation(now, after))
    return _second_difference(a, b, seconds_before, seconds_after)


@factor(POSE, POSE, POSE, data={"seconds_before": (), "seconds_after": ()}, dim=3)
def camera_linear_acceleration(
    before: Array, now: Array, after: Array, *, seconds_before: Array, seconds_after: Array
) -> Array:
    """Return (N, 3) m/s^2 of three poses (N, 4, 4) and the times between them (N,), s."""
    a = now[..., :3, 3] - before[..., :3, 3]
    b = after[..., :3, 3] - now[..., :3, 3]
    return _second_difference(a, b, seconds_before, seconds_after)


def _factors_of_steps(before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return d r / d a and d r / d b, each (N, 1, 1) times the identity."""
    mean = 0.5 * (before + after)
    return (-1.0 / (mean * before))[:, None, None], (1.0 / (mean * after))[:, None, None]


@camera_angular_acceleration.jacobian
def camera_angular_acceleration_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray, *, seconds_before: FloatArray, seconds_after: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a = rotation_log(relative_rotation(before, now))
    b = rotation_log(relative_rotation(now, after))
    by_a, by_b = _factors_of_steps(seconds_before, seconds_after)
    right_a, right_b = so3_inverse_right_jacobian(a), so3_inverse_right_jacobian(b)
    # The left Jacobian's inverse is the transpose of the right one's.
    left_a, left_b = np.swapaxes(right_a, 1, 2), np.swapaxes(right_b, 1, 2)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    jacobians[0][:, :, :3] = -by_a * left_a
    jacobians[1][:, :, :3] = by_a * right_a - by_b * left_b
    jacobians[2][:, :, :3] = by_b * right_b
    return _second_difference(a, b, seconds_before, seconds_after), jacobians


@camera_linear_acceleration.jacobian
def camera_linear_acceleration_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray, *, seconds_before: FloatArray, seconds_after: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a = now[:, :3, 3] - before[:, :3, 3]
    b = after[:, :3, 3] - now[:, :3, 3]
    by_a, by_b = _factors_of_steps(seconds_before, seconds_after)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    jacobians[0][:, :, 3:] = -by_a * before[:, :3, :3]
    jacobians[1][:, :, 3:] = (by_a - by_b) * now[:, :3, :3]
    jacobians[2][:, :, 3:] = by_b * after[:, :3, :3]
    return _second_difference(a, b, seconds_before, seconds_after), jacobians
