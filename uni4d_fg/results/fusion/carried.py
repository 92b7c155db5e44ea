"""Depth of one frame as other frames show it: carried over by the cameras, nearest surface first."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray


def carried_depth(
    shape: tuple[int, int],
    world_T_cam: FloatArray,
    others: Iterable[tuple[Float32Array, FloatArray, FloatArray]],
    intrinsics: FloatArray,
) -> Float32Array:
    """Carry depth of other frames into a frame.

    Every pixel of the others is put on the four pixels around where it falls; where several fall on one, the nearest
    counts. What stays empty takes the depth of the pixels around it.

    Args:
        shape: (H, W) of the frame.
        world_T_cam: (4, 4) its pose.
        others: Depth (H, W), NaN where missing, m, pose (4, 4) and intrinsics (4,) px of each other frame.
        intrinsics: (4,) px, of the frame.

    Returns:
        (H, W) m; NaN everywhere if nothing falls into the frame.
    """
    height, width = shape
    fx, fy, cx, cy = intrinsics
    inverse = np.zeros(height * width)
    for depth, pose, camera in others:
        v, u = np.nonzero(np.isfinite(depth))
        z = depth[v, u].astype(np.float64)
        points = np.stack([(u - camera[2]) / camera[0] * z, (v - camera[3]) / camera[1] * z, z])
        cam_T_other = np.linalg.solve(world_T_cam, pose)
        x, y, z = cam_T_other[:3, :3] @ points + cam_T_other[:3, 3:]
        front = z > 1e-6
        x, y, z = x[front], y[front], z[front]
        column, row = np.floor(fx * x / z + cx), np.floor(fy * y / z + cy)
        for step_v, step_u in ((0, 0), (0, 1), (1, 0), (1, 1)):
            i, j = row + step_v, column + step_u
            inside = (i >= 0) & (j >= 0) & (i < height) & (j < width)
            at = i[inside].astype(np.int64) * width + j[inside].astype(np.int64)
            order = np.argsort(z[inside])[::-1]  # of pixels written twice, the last stays: the nearest
            nearest = np.zeros(height * width)
            nearest[at[order]] = 1.0 / z[inside][order]
            np.maximum(inverse, nearest, out=inverse)
    filled = filled_smoothly(inverse.reshape(shape).astype(np.float32), inverse.reshape(shape) > 0)
    with np.errstate(divide="ignore"):
        return np.where(filled > 0, 1.0 / filled, np.nan).astype(np.float32)


def filled_smoothly(values: Float32Array, known: BoolArray) -> Float32Array:
    """Fill holes by averages over windows that grow until all is filled."""
    radius, shape = 2.0, values.shape
    while known.any() and not known.all() and radius < 2 * max(shape):
        mass = cv2.GaussianBlur(known.astype(np.float32), (0, 0), radius)
        mean = cv2.GaussianBlur(np.where(known, values, np.float32(0)), (0, 0), radius) / np.maximum(mass, 1e-6)
        near = ~known & (mass > 0.05)
        values = np.where(near, mean, values).astype(np.float32)
        known = known | near
        radius *= 2.0
    return values
