"""SE(3) and SO(3) on batches of matrices, with the tangent order and retraction of ``gtsam.Pose3``.

A tangent vector is ``(omega, v)``: rotation first, both in the body (camera) frame, so that a pose is
updated on the right, ``T <- T Exp(omega, v)``, exactly as ``gtsam.Pose3.retract`` does.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray

_SMALL_ANGLE = 1e-6


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
    """Return Ad (6, 6) of a rigid transform: ``T Exp(xi) = Exp(Ad xi) T``, rotation first."""
    out = np.zeros((6, 6))
    rotation, centre = transform[:3, :3], transform[:3, 3]
    out[:3, :3] = out[3:, 3:] = rotation
    out[3:, :3] = skew(centre) @ rotation
    return out
