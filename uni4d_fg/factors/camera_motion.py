r"""Relative camera motion over three poses, E_cam = E_rot + E_trans.

    r = (a - b) / ((|a|_f + |b|_f) / 2),   |v|_f = sqrt(|v|^2 + floor^2)      [dimensionless], 3-vectors

    translation   a = c_t - c_{t-1},               b = c_{t+1} - c_t               (world axes, m)
                  a = R_t^T (c_t - c_{t-1}),       b = R_{t+1}^T (c_{t+1} - c_t)   (axes of the later camera, m)
    rotation      a = Log(R_{t-1}^T R_t),          b = Log(R_t^T R_{t+1})          (rad)

The change of the relative motion, relative to its size: 0 for constant velocity, at most 2. ``floor`` (m or
rad) guards the denominator: for a camera at rest the paper's ratio is 0/0, this one is 0 with a finite
Jacobian. Variables: the poses of frames t-1, t, t+1. The rotation's logarithm is singular for a half turn
between two frames, which video does not have. Source: Uni4D, camera motion term (vector form). In axes of the later
camera, the translation is that of the paper's relative pose xi_{t+1}^{-1} xi_t but for the sign; a camera that moves
steadily on a circle costs nothing then. In world axes, as in the authors' program, the straight way costs nothing.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.geometry.se3 import relative_rotation, rotation_log, skew, so3_inverse_right_jacobian


def _relative_change(a: Array, b: Array, floor: Array) -> Array:
    xp = namespace(a)
    norm_a = xp.sqrt(xp.sum(a * a, axis=-1) + floor**2)
    norm_b = xp.sqrt(xp.sum(b * b, axis=-1) + floor**2)
    return (a - b) / (0.5 * (norm_a + norm_b))[..., None]


@factor(POSE, POSE, POSE, data={"floor": ()}, dim=3)
def camera_rotation(before: Array, now: Array, after: Array, *, floor: Array) -> Array:
    """Return (N, 3) of three poses (N, 4, 4) and the floor (N,), rad."""
    a = rotation_log(relative_rotation(before, now))
    b = rotation_log(relative_rotation(now, after))
    return _relative_change(a, b, floor)


@factor(POSE, POSE, POSE, data={"floor": ()}, dim=3)
def camera_translation(before: Array, now: Array, after: Array, *, floor: Array) -> Array:
    """Return (N, 3) of three poses (N, 4, 4) and the floor (N,), m."""
    a = now[..., :3, 3] - before[..., :3, 3]
    b = after[..., :3, 3] - now[..., :3, 3]
    return _relative_change(a, b, floor)


@factor(POSE, POSE, POSE, data={"floor": ()}, dim=3, term="camera_translation")
def relative_camera_translation(before: Array, now: Array, after: Array, *, floor: Array) -> Array:
    """Return (N, 3) of three poses (N, 4, 4) and the floor (N,), m; each motion in the axes of its later camera."""
    return _relative_change(_in_later_axes(before, now), _in_later_axes(now, after), floor)


def _in_later_axes(first: Array, second: Array) -> Array:
    """Return R_2^T (c_2 - c_1), (N, 3) m, of poses (N, 4, 4)."""
    xp = namespace(first)
    step = second[..., :3, 3] - first[..., :3, 3]
    return xp.sum(second[..., :3, :3] * step[..., :, None], axis=-2)


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


@camera_rotation.jacobian
def camera_rotation_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray, *, floor: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a = rotation_log(relative_rotation(before, now))
    b = rotation_log(relative_rotation(now, after))
    r, by_a, by_b = _relative_change_derivatives(a, b, floor)
    right_a, right_b = so3_inverse_right_jacobian(a), so3_inverse_right_jacobian(b)
    # The left Jacobian's inverse is the transpose of the right one's.
    left_a, left_b = np.swapaxes(right_a, 1, 2), np.swapaxes(right_b, 1, 2)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    jacobians[0][:, :, :3] = -by_a @ left_a
    jacobians[1][:, :, :3] = by_a @ right_a - by_b @ left_b
    jacobians[2][:, :, :3] = by_b @ right_b
    return r, jacobians


@camera_translation.jacobian
def camera_translation_jacobian(
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


@relative_camera_translation.jacobian
def relative_camera_translation_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray, *, floor: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of the three poses, each (N, 3, 6)."""
    a, b = np.asarray(_in_later_axes(before, now)), np.asarray(_in_later_axes(now, after))
    r, by_a, by_b = _relative_change_derivatives(a, b, floor)
    jacobians = [np.zeros((len(a), 3, 6)) for _ in range(3)]
    # (R_2 Exp(omega))^T v = R_2^T v + skew(R_2^T v) omega; a center moves by R times its step in body axes.
    jacobians[0][:, :, 3:] = -by_a @ relative_rotation(now, before)
    jacobians[1][:, :, :3] = by_a @ skew(a)
    jacobians[1][:, :, 3:] = by_a - by_b @ relative_rotation(after, now)
    jacobians[2][:, :, :3] = by_b @ skew(b)
    jacobians[2][:, :, 3:] = by_b
    return r, jacobians
