"""Derivatives of the pinhole projection, shared by every term that projects."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.geometry.camera import inverse_depth, inverse_depth_slope


def projection_derivatives(intrinsics: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Differentiate ``project(intrinsics, x)``.

    Args:
        intrinsics: (N, 4) px.
        x: (N, 3) camera-frame points, m.

    Returns:
        d uv / d x (N, 2, 3) in px/m, and d uv / d intrinsics (N, 2, 4).
    """
    g, slope = inverse_depth(x[:, 2]), inverse_depth_slope(x[:, 2])
    by_point = np.zeros((len(x), 2, 3))
    by_point[:, 0, 0] = intrinsics[:, 0] * g
    by_point[:, 0, 2] = intrinsics[:, 0] * x[:, 0] * slope
    by_point[:, 1, 1] = intrinsics[:, 1] * g
    by_point[:, 1, 2] = intrinsics[:, 1] * x[:, 1] * slope
    by_intrinsics = np.zeros((len(x), 2, 4))
    by_intrinsics[:, 0, 0] = x[:, 0] * g
    by_intrinsics[:, 1, 1] = x[:, 1] * g
    by_intrinsics[:, 0, 2] = 1.0
    by_intrinsics[:, 1, 3] = 1.0
    return by_point, by_intrinsics


def chain_to_pose(by_point: FloatArray, x: FloatArray) -> FloatArray:
    """Chain d uv / d x (N, 2, 3) with d x / d xi = [skew(x), -I] of ``x = R^T (p - c)``.

    Args:
        by_point: (N, 2, 3), with the zero pattern of :func:`projection_derivatives`.
        x: (N, 3) camera-frame points.

    Returns:
        (N, 2, 6) derivative with respect to the body-frame twist (omega, v) of the observing camera.
    """
    a, b = by_point[:, 0, 0], by_point[:, 0, 2]
    c, d = by_point[:, 1, 1], by_point[:, 1, 2]
    out = np.empty((len(x), 2, 6))
    out[:, 0, 0] = -b * x[:, 1]
    out[:, 0, 1] = b * x[:, 0] - a * x[:, 2]
    out[:, 0, 2] = a * x[:, 1]
    out[:, 1, 0] = c * x[:, 2] - d * x[:, 1]
    out[:, 1, 1] = d * x[:, 0]
    out[:, 1, 2] = -c * x[:, 0]
    np.negative(by_point, out=out[:, :, 3:])
    return out


def chain_to_world_point(by_point: FloatArray, world_T_cam: FloatArray) -> FloatArray:
    """Chain d uv / d x (N, 2, 3) with d x / d p = R^T; same zero pattern. Returns (N, 2, 3)."""
    rotation = world_T_cam[:, :3, :3]
    out = np.empty((len(by_point), 2, 3))
    optical_axis = rotation[:, :, 2]
    out[:, 0] = by_point[:, 0, 0, None] * rotation[:, :, 0] + by_point[:, 0, 2, None] * optical_axis
    out[:, 1] = by_point[:, 1, 1, None] * rotation[:, :, 1] + by_point[:, 1, 2, None] * optical_axis
    return out
