r"""Surface normals from depth maps.

For a plane n . X = d, and X = z (x, y, 1) of a pixel whose ray is (x, y, 1), the inverse depth is affine in the ray:
1/z = (n_x x + n_y y + n_z) / d. Its gradient over a window, by least squares, is the normal. Inverse depth is fitted,
not points, because its noise is nearly even over the image, and planes stay planes under perspective.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.geometry.camera import project
from uni4d_fg.geometry.se3 import inverse
from uni4d_fg.results.fusion.clouds import depth_edges

WINDOW_PX = 9
"""Side of the window at 640 px of image width; wider images take wider windows, so that noise averages out alike."""
EDGE = 0.05
"""Neighboring pixels whose depth differs by more than this part are of two surfaces."""
SEEN_WITHIN = 0.03
"""A cloud's point is on a frame's surface if its depth is that of the frame within this part."""

_MIN_PART = 0.3
"""Part of a window's pixels that must have depth."""


def normal_map(depth: Float32Array, intrinsics: FloatArray) -> Float32Array:
    """Return the normals of a depth map of a pinhole, in camera axes, towards the camera.

    Args:
        depth: (H, W) meters, NaN where missing.
        intrinsics: (4,) fx, fy, cx, cy, px.

    Returns:
        (H, W, 3) unit vectors, x right, y down, z forward; NaN where depth is missing, at depth edges, or alone.
    """
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        known = np.isfinite(depth) & (depth > 0.0)
        # An edge splits windows: without its pixels, a window mostly holds one surface.
        inner = known & ~depth_edges(depth, EDGE)
        q = np.where(known, 1.0 / depth.astype(np.float64), 0.0)
    side = max(3, 2 * round(WINDOW_PX * width / 640 / 2) + 1)

    def mean(values: FloatArray) -> FloatArray:
        summed = cv2.boxFilter(values * inner, cv2.CV_64F, (side, side), normalize=True, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed)

    weight = mean(np.ones_like(q))
    enough = known & (weight >= _MIN_PART)
    safe = np.where(enough, weight, 1.0)
    mx, my, mq = mean(x) / safe, mean(y) / safe, mean(q) / safe
    xx, xy, yy = mean(x * x) / safe - mx * mx, mean(x * y) / safe - mx * my, mean(y * y) / safe - my * my
    xq, yq = mean(x * q) / safe - mx * mq, mean(y * q) / safe - my * mq
    determinant = xx * yy - xy * xy
    enough &= determinant > 1e-6 * (xx + yy) ** 2
    safe = np.where(enough, determinant, 1.0)
    a, b = (yy * xq - xy * yq) / safe, (xx * yq - xy * xq) / safe
    away = np.stack((a, b, mq - a * mx - b * my), axis=-1)
    length = np.linalg.norm(away, axis=-1)
    enough &= length > 0.0
    unit = -away / np.where(enough, length, 1.0)[..., None]
    return np.where(enough[..., None], unit, np.nan).astype(np.float32)


def cloud_normals(
    points: FloatArray,
    depths: Iterable[tuple[int, Float32Array]],
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
) -> FloatArray:
    """Return normals of a cloud's points: the mean of those of the frames on whose surface they lie.

    Args:
        points: (N, 3) world, meters.
        depths: Frame numbers and their maps (H, W), meters, NaN where missing.
        intrinsics: (T, 4) px, of a pinhole.
        world_T_cam: (T, 4, 4) camera to world.

    Returns:
        (N, 3) unit vectors in world axes, towards the cameras that saw the points; towards the nearest camera for
        points that lie on no frame's surface.
    """
    total = np.zeros((len(points), 3))
    for frame, depth in depths:
        pose, camera = world_T_cam[frame], intrinsics[frame]
        row, u, v = _seen(points, depth, camera, pose)
        here = normal_map(depth, camera)[v, u].astype(np.float64)
        good = np.isfinite(here).all(axis=1)
        total[row[good]] += here[good] @ pose[:3, :3].T
    centers = world_T_cam[:, :3, 3]
    length = np.linalg.norm(total, axis=1)
    blank = np.flatnonzero(length < 1e-9)
    if len(blank):
        squared = ((points[blank, None] - centers[None]) ** 2).sum(axis=2)
        total[blank] = centers[squared.argmin(axis=1)] - points[blank]
        length[blank] = np.linalg.norm(total[blank], axis=1)
    return np.asarray(total / np.maximum(length, 1e-12)[:, None])


def normal_colors(normals: Float32Array) -> ImageArray:
    """Return normals (..., 3) as 8-bit RGB, (n + 1) / 2 * 255; those that are not known as zero vectors (128)."""
    colors: ImageArray = np.rint(np.clip(np.nan_to_num(normals) * 127.5 + 127.5, 0.0, 255.0)).astype(np.uint8)
    return colors


def _seen(
    points: FloatArray, depth: Float32Array, camera: FloatArray, pose: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the rows of points on the surface of a frame, and their pixels u and v."""
    height, width = depth.shape
    cam_T_world = inverse(pose)
    local = points @ cam_T_world[:3, :3].T + cam_T_world[:3, 3]
    front = np.flatnonzero(local[:, 2] > 0.0)
    uv = np.rint(project(camera, local[front]))
    inside = ((uv >= 0) & (uv <= [width - 1, height - 1])).all(axis=1)
    row, uv = front[inside], uv[inside].astype(np.int64)
    surface, z = depth[uv[:, 1], uv[:, 0]], local[row, 2]
    with np.errstate(invalid="ignore"):
        near = np.abs(surface - z) <= SEEN_WITHIN * z
    return row[near], uv[near, 0], uv[near, 1]
