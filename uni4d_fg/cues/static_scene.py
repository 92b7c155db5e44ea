r"""Where the pixels of one frame would be seen in another if nothing moved.

A pixel ``u`` of frame i with depth ``z`` is seen in frame j at

    u'(z) = pi(K, R x(u, z) + t),    x(u, z) = z K^-1 (u, 1),    (R, t) = cam_j_T_cam_i,

and an error of its log depth moves it along the epipolar line, by ``du'/dlog z`` per unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray

AnyFloat = npt.NDArray[np.floating]

_NEAREST = 1e-2
"""Smallest z, as a part of the depth that was lifted; points behind the camera are put there."""


@dataclass(frozen=True)
class StaticPrediction:
    """Pixels of one frame as another one sees them in a static scene; arrays of the shape of the pixels."""

    u: AnyFloat
    v: AnyFloat
    """Predicted pixel."""
    z: AnyFloat
    """Predicted depth."""
    du: AnyFloat
    dv: AnyFloat
    """Change of the predicted pixel per unit of log depth, px: the direction of the epipolar line."""


def predict_static(
    u: AnyFloat, v: AnyFloat, log_depth: AnyFloat, target_T_source: FloatArray, intrinsics: FloatArray
) -> StaticPrediction:
    """Predict where pixels of a source frame are seen in a target frame if they are static.

    Args:
        u: Columns, px, any shape.
        v: Rows, px.
        log_depth: Natural logarithm of their depth.
        target_T_source: (4, 4) pose of the source camera in the target camera.
        intrinsics: (4,) fx, fy, cx, cy, px.
    """
    return predict_static_at(u, v, np.exp(log_depth), target_T_source, intrinsics)


def predict_static_at(
    u: AnyFloat,
    v: AnyFloat,
    z: AnyFloat,
    target_T_source: FloatArray,
    intrinsics: FloatArray,
    target_intrinsics: FloatArray | None = None,
) -> StaticPrediction:
    """Do what :func:`predict_static` does, from depth itself.

    Args:
        u: Columns, px, of a shape that NumPy broadcasts to that of the depth.
        v: Rows, px, likewise.
        z: Depth.
        target_T_source: (4, 4) pose of the source camera in the target camera.
        intrinsics: (4,) fx, fy, cx, cy, px.
        target_intrinsics: (4,) of the target, where the camera zooms; None for the same.
    """
    fx, fy, cx, cy = (np.float32(value) for value in intrinsics)
    rotation, shift = target_T_source[:3, :3].astype(np.float32), target_T_source[:3, 3].astype(np.float32)
    x, y = (u - cx) / fx, (v - cy) / fy
    if target_intrinsics is not None:
        fx, fy, cx, cy = (np.float32(value) for value in target_intrinsics)
    # The ray turned by R, times z, is also the derivative of the point by log z.
    ray = [(row[0] * x + row[1] * y + row[2]) * z for row in rotation]
    depth = np.maximum(ray[2] + shift[2], _NEAREST * z)
    a, b = (ray[0] + shift[0]) / depth, (ray[1] + shift[1]) / depth
    slope = ray[2] / depth
    return StaticPrediction(
        fx * a + cx,
        fy * b + cy,
        depth,
        fx * (ray[0] / depth - a * slope),
        fy * (ray[1] / depth - b * slope),
    )


def relative_pose(world_T_cam: FloatArray, source: int, target: int) -> FloatArray:
    """Return the pose (4, 4) of camera ``source`` in camera ``target``."""
    result: FloatArray = np.linalg.inv(world_T_cam[target]) @ world_T_cam[source]
    return result
