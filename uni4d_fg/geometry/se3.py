"""SE(3) and SO(3) on batches of matrices, with the tangent order and retraction of ``gtsam.Pose3``.

A tangent vector is ``(omega, v)``: rotation first, both in the body (camera) frame, so that a pose is
updated on the right, ``T <- T Exp(omega, v)``, exactly as ``gtsam.Pose3.retract`` does.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace

_SMALL_ANGLE = 1e-6
_SMALL_INVERSE = 1e-4
"""Angle below which inverse Jacobians use their series: theirs cancels earlier."""
_SMALL_SQUARED_ANGLE = 1e-8
_SERIES_SQUARED_ANGLE = 1e-2
"""Squared angle, rad^2, below which the logarithm and its Jacobian use their series."""


def skew(v: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) cross-product matrices of (..., 3) vectors."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _rodrigues_coefficients(angle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return sin(a)/a, (1-cos a)/a^2 and (a-sin a)/a^3 with their limits at zero."""
    small = angle < _SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - angle**2 / 6.0, np.sin(a) / a)
    # 2 sin^2(a/2) avoids the cancellation of 1 - cos a.
    second = np.where(small, 0.5 - angle**2 / 24.0, 2.0 * np.sin(0.5 * a) ** 2 / a**2)
    third = np.where(small, 1.0 / 6.0, (a - np.sin(a)) / a**3)
    return first, second, third


def so3_exp(omega: FloatArray) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    angle = np.linalg.norm(omega, axis=-1)
    first, second, _ = _rodrigues_coefficients(angle)
    w = skew(omega)
    result: FloatArray = np.eye(3) + first[..., None, None] * w + second[..., None, None] * (w @ w)
    return result


def so3_log(rotation: FloatArray) -> FloatArray:
    """Return rotation vectors (..., 3), radians, of rotation matrices (..., 3, 3); angle in [0, pi]."""
    from scipy.spatial.transform import Rotation

    flat = rotation.reshape(-1, 3, 3)
    result: FloatArray = Rotation.from_matrix(flat).as_rotvec().reshape(*rotation.shape[:-2], 3)
    return result


def se3_exp(xi: FloatArray) -> FloatArray:
    """Return transforms (..., 4, 4) of twists (..., 6) = (omega [rad], v [m])."""
    omega, v = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(omega, axis=-1)
    _, second, third = _rodrigues_coefficients(angle)
    w = skew(omega)
    left = np.eye(3) + second[..., None, None] * w + third[..., None, None] * (w @ w)
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = so3_exp(omega)
    out[..., :3, 3] = (left @ v[..., None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def retract(world_T_cam: FloatArray, xi: FloatArray) -> FloatArray:
    """Update poses (..., 4, 4) by body-frame twists (..., 6): ``T Exp(xi)``."""
    result: FloatArray = world_T_cam @ se3_exp(xi)
    return result


def inverse(transform: FloatArray) -> FloatArray:
    """Invert rigid transforms (..., 4, 4)."""
    out = np.zeros_like(transform)
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -(rotation_t @ transform[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def orthonormalize(transform: FloatArray) -> FloatArray:
    """Project the rotation of (..., 4, 4) transforms onto SO(3) (nearest in the Frobenius norm)."""
    u, _, vt = np.linalg.svd(transform[..., :3, :3])
    sign = np.sign(np.linalg.det(u @ vt))
    u = u.copy()
    u[..., :, 2] *= sign[..., None]
    out = transform.copy()
    out[..., :3, :3] = u @ vt
    return out


def adjoint(transform: FloatArray) -> FloatArray:
    """Return Ad (..., 6, 6) of rigid transforms (..., 4, 4): ``T Exp(xi) = Exp(Ad xi) T``, rotation first."""
    out = np.zeros((*transform.shape[:-2], 6, 6))
    rotation, center = transform[..., :3, :3], transform[..., :3, 3]
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(center) @ rotation
    return out


def rotation_log(rotation: Array) -> Array:
    """Return rotation vectors (N, 3), rad, of matrices (N, 3, 3); NumPy or torch, differentiable at the identity.

    Below a half turn only: :func:`so3_log` has no such limit and no derivative.
    """
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


def relative_rotation(first: Array, second: Array) -> Array:
    """Return R_first^T R_second (N, 3, 3) of poses (N, 4, 4); NumPy or torch."""
    a, b = first[..., :3, :3], second[..., :3, :3]
    xp = namespace(a)
    return xp.sum(a[..., :, :, None] * b[..., :, None, :], axis=-3)


def rotation_matrix(rotation_vector: Array) -> Array:
    """Return matrices (N, 3, 3) of rotation vectors (N, 3), rad; NumPy or torch, differentiable at zero.

    Rodrigues: R = I + (sin a / a) W + ((1 - cos a) / a^2) W^2 with W the cross-product matrix and a the angle.
    """
    xp = namespace(rotation_vector)
    x, y, z = rotation_vector[..., 0], rotation_vector[..., 1], rotation_vector[..., 2]
    squared = x * x + y * y + z * z
    small = squared < _SMALL_SQUARED_ANGLE
    angle = xp.sqrt(xp.where(small, 1.0 + 0.0 * squared, squared))
    first = xp.where(small, 1.0 - squared / 6.0, xp.sin(angle) / angle)
    half = xp.sin(0.5 * angle) / angle
    second = xp.where(small, 0.5 - squared / 24.0, 2.0 * half * half)
    rows = (
        (1.0 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y),
        (second * x * y + first * z, 1.0 - second * (x * x + z * z), second * y * z - first * x),
        (second * x * z - first * y, second * y * z + first * x, 1.0 - second * (x * x + y * y)),
    )
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def from_rotation_vector(rotation_vector: Array, translation: Array) -> Array:
    """Return transforms (N, 4, 4) of rotation vectors (N, 3), rad, and translations (N, 3), m; NumPy or torch."""
    xp = namespace(rotation_vector)
    top = xp.concat((rotation_matrix(rotation_vector), translation[..., None]), axis=-1)
    last = 0.0 * top[..., :1, :]
    one = xp.concat((last[..., :3], 1.0 + last[..., 3:]), axis=-1)
    return xp.concat((top, one), axis=-2)


def so3_inverse_right_jacobian(omega: FloatArray) -> FloatArray:
    """Return Jr^{-1} with Log(Exp(omega) Exp(d)) = omega + Jr^{-1} d, (N, 3, 3)."""
    w, coefficient = skew(omega), _inverse_jacobian_coefficient(omega)
    result: FloatArray = np.eye(3) + 0.5 * w + coefficient[:, None, None] * (w @ w)
    return result


def _inverse_jacobian_coefficient(omega: FloatArray) -> FloatArray:
    """Return (1 - a/2 cot(a/2)) / a^2, (N,), the coefficient of W^2 in the inverse Jacobians of SO(3)."""
    angle = np.linalg.norm(omega, axis=-1)
    small = angle < _SMALL_INVERSE
    safe = np.where(small, 1.0, angle)
    result: FloatArray = np.where(
        small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2
    )
    return result


def se3_log(transform: FloatArray) -> FloatArray:
    """Return twists (N, 6) = (omega [rad], v [m]) with ``se3_exp(twist) == transform`` (N, 4, 4)."""
    omega = so3_log(transform[:, :3, :3])
    # The left Jacobian's inverse is the transpose of the right one's.
    inverse_left = np.swapaxes(so3_inverse_right_jacobian(omega), 1, 2)
    v = (inverse_left @ transform[:, :3, 3, None])[:, :, 0]
    return np.concatenate([omega, v], axis=1)


def relative_twist(first: Array, second: Array) -> Array:
    """Return Log(T_first^{-1} T_second), (N, 6) = (omega [rad], v [m]), of poses (N, 4, 4); NumPy or torch.

    Below a half turn only, where it is differentiable; at a half turn the rotation is taken for none.
    """
    xp = namespace(first)
    omega = rotation_log(relative_rotation(first, second))
    t = xp.sum(first[..., :3, :3] * (second[..., :3, 3] - first[..., :3, 3])[..., :, None], axis=-2)
    squared = xp.sum(omega * omega, axis=-1)
    small = squared < _SERIES_SQUARED_ANGLE
    safe = xp.where(small, 1.0 + 0.0 * squared, squared)
    half = 0.5 * xp.sqrt(safe)
    # v = (I - W / 2 + c W^2) t with W = skew(omega), c = (1 - (a/2) cot(a/2)) / a^2
    exact = (1.0 - half * xp.cos(half) / xp.sin(half)) / safe
    series = 1.0 / 12.0 + squared / 720.0 + squared**2 / 30240.0 + squared**3 / 1209600.0
    turned = _cross(omega, t)
    v = t - 0.5 * turned + xp.where(small, series, exact)[..., None] * _cross(omega, turned)
    return xp.concat((omega, v), axis=-1)


def _cross(a: Array, b: Array) -> Array:
    xp = namespace(a)
    return xp.stack(
        (
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ),
        axis=-1,
    )


def inverse_right_jacobian(twist: FloatArray) -> FloatArray:
    """Return J with ``Log(Exp(twist) Exp(d)) = twist + J d + O(d^2)``, (N, 6, 6), for twists (N, 6) below two pi.

    With ad the matrix of the Lie bracket, J = I + ad / 2 + alpha ad^2 + beta ad^4: every even power from the sixth on
    is a combination of these two, because ad (ad^2 + a^2)^2 = 0 for the angle a. That of ``-twist`` is the left
    Jacobian's inverse.
    """
    squared = np.sum(twist[:, :3] ** 2, axis=1)
    small = squared < _SERIES_SQUARED_ANGLE
    safe = np.where(small, 1.0, squared)
    half = 0.5 * np.sqrt(safe)
    # f(-a^2) = (a/2) cot(a/2) - 1, the even part of the series, and -a^2 f'(-a^2), fix alpha and beta.
    even = half / np.tan(half) - 1.0
    slope = 0.5 * (half / np.tan(half) - (half / np.sin(half)) ** 2)
    alpha = np.where(small, 1.0 / 12.0 - squared**2 / 30240.0 - squared**3 / 604800.0, (slope - 2.0 * even) / safe)
    beta = np.where(small, -1.0 / 720.0 - squared / 15120.0 - squared**2 / 403200.0, (slope - even) / safe**2)
    ad = np.zeros((len(twist), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = skew(twist[:, :3])
    ad[:, 3:, :3] = skew(twist[:, 3:])
    ad_squared = ad @ ad
    result: FloatArray = (
        np.eye(6) + 0.5 * ad + alpha[:, None, None] * ad_squared + beta[:, None, None] * (ad_squared @ ad_squared)
    )
    return result


def composed_covariance(reference: FloatArray, reference_T_cam: FloatArray, relative: FloatArray) -> FloatArray:
    """Return the covariance of ``world_T_reference reference_T_cam`` from those of its two parts, (6, 6) each."""
    back = adjoint(inverse(reference_T_cam))
    result: FloatArray = back @ reference @ back.T + relative
    return result
