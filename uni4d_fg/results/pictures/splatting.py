"""A small point renderer in NumPy: a depth buffer, discs of the points' own size, and soft edge shading."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.geometry.camera import project, world_to_camera

_MAX_RADIUS_PX = 6
_RADII_PX = np.array([0.0, 1.0, 1.42, 2.0, 2.24, 3.0, 4.0, 5.0, 6.0])
"""Radii that discs are rounded down to: from each to the next, other pixels are inside."""
_NEAR_M = 1e-3
_FAR_M = 1e9
_MOST_SHADE = np.float32(0.2)
"""What one neighbor in front adds to the shade at most."""


@dataclass(frozen=True)
class View:
    """A virtual camera."""

    world_T_cam: FloatArray
    """(4, 4) camera to world, OpenCV axes."""
    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px."""
    image_size: tuple[int, int]
    """(height, width), px."""

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (..., 2) and depths (...) of world points (..., 3); NaN behind the camera."""
        camera = world_to_camera(self.world_T_cam, points)
        depth = np.where(camera[..., 2] > _NEAR_M, camera[..., 2], np.nan)
        camera = np.where(np.isfinite(depth)[..., None], camera, np.nan)
        return project(self.intrinsics, camera), depth

    def scaled(self, factor: int) -> View:
        """Return the same view with ``factor`` times the pixels in each direction."""
        height, width = self.image_size
        fx, fy, cx, cy = self.intrinsics * factor
        half = 0.5 * (factor - 1)
        return View(self.world_T_cam, np.array([fx, fy, cx + half, cy + half]), (height * factor, width * factor))


def look_at(eye: FloatArray, target: FloatArray, up: FloatArray) -> FloatArray:
    """Return the pose (4, 4) of a camera at ``eye`` that looks at ``target``, with ``up`` upwards."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    pose[:3, 3] = eye
    return pose


def render(
    view: View,
    points: FloatArray,
    colors: ImageArray,
    point_size_m: FloatArray,
    background: tuple[int, int, int],
    *,
    smallest_px: float = 1.0,
    edge_strength: float = 2.2,
) -> tuple[ImageArray, FloatArray]:
    """Render a cloud, drawn at twice the resolution and averaged down.

    Args:
        view: Virtual camera.
        points: (N, 3) world positions, meters.
        colors: (N, 3) RGB.
        point_size_m: (N,) diameter of each point, meters.
        background: RGB where there is no point.
        smallest_px: Least radius of a disc, in half pixels.
        edge_strength: How much what lies behind an edge is darkened; 0 leaves colors as they are.

    Returns:
        Image (H, W, 3) and depth (H, W), meters, infinite where there is no point.
    """
    fine = view.scaled(2)
    color, depth = _splat(fine, points, colors, point_size_m, smallest_px)
    shade = _edge_shading(depth, edge_strength)
    color *= shade[..., None]
    color[~np.isfinite(depth)] = background
    height, width = view.image_size
    image = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
    rows = np.minimum(depth[::2], depth[1::2])
    nearest = np.minimum(rows[:, ::2], rows[:, 1::2])
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), nearest


def _splat(
    view: View, points: FloatArray, colors: ImageArray, point_size_m: FloatArray, smallest_px: float
) -> tuple[Float32Array, FloatArray]:
    """Return color (H, W, 3) and depth (H, W) of the nearest disc in each pixel.

    Of the points whose middle is in one pixel the nearest is kept; its disc is then spread by a minimum filter, for
    all points of one radius at once. So the work grows with points and with pixels, not with their product.
    """
    height, width = view.image_size
    uv, z = view.project(points)
    column, row = np.rint(np.nan_to_num(uv, nan=-1e6)).clip(-1e6, 1e6).astype(np.int64).T
    margin = _MAX_RADIUS_PX
    near = np.isfinite(z) & (column >= -margin) & (row >= -margin) & (column < width + margin) & (row < height + margin)
    column, row, z, colors = column[near] + margin, row[near] + margin, z[near], colors[near]
    radius = np.clip(0.5 * view.intrinsics[0] * point_size_m[near] / z, smallest_px, _MAX_RADIUS_PX)
    # Depth in the high bits and the point's number in the low ones: the minimum is the nearest point. Read as
    # floating-point numbers, such patterns keep their order, and OpenCV has a fast minimum of those.
    bits = z.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    key = (bits | np.arange(len(z), dtype=np.uint64)).view(np.float64)
    padded = height + 2 * margin, width + 2 * margin
    buffer = np.full(padded, np.inf)
    np.minimum.at(buffer.reshape(-1), row * padded[1] + column, key)
    filled = np.isfinite(buffer)
    steps = np.zeros(padded, np.int64)
    numbers = (buffer[filled].view(np.uint64) & np.uint64(0xFFFFFFFF)).astype(np.int64)
    steps[filled] = np.searchsorted(_RADII_PX, radius[numbers], side="right") - 1
    nearest = buffer.copy()
    for step, reach in enumerate(_RADII_PX):
        here = filled & (steps == step)
        if reach < 1.0 or not here.any():
            continue
        # Nothing reaches farther than its disc: only the part around it is worked on.
        rows, columns = (np.flatnonzero(here.any(axis=axis)) for axis in (1, 0))
        part = (
            slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
            slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
        )
        spread = cv2.erode(np.where(here[part], buffer[part], np.inf), _disc(reach), borderType=cv2.BORDER_REPLICATE)
        np.minimum(nearest[part], spread, out=nearest[part])
    nearest = nearest[margin:-margin, margin:-margin]
    filled = np.isfinite(nearest)
    index = (nearest[filled].view(np.uint64) & np.uint64(0xFFFFFFFF)).astype(np.int64)
    color, depth = np.zeros((height, width, 3), np.float32), np.full((height, width), np.inf)
    color[filled], depth[filled] = colors[index], z[index]
    return color, depth


def _disc(radius: float) -> ImageArray:
    """Return a filter of the pixels within a radius, px."""
    reach = int(radius)
    offset = np.arange(-reach, reach + 1)
    inside = offset[:, None] ** 2 + offset[None, :] ** 2 <= radius**2
    return np.asarray(inside, dtype=np.uint8)


def _edge_shading(depth: FloatArray, strength: float) -> Float32Array:
    """Darken pixels that lie behind their neighbors (eye-dome lighting): factors (H, W) in (0, 1]."""
    # What is empty counts as far away: beside nothing nothing is darkened.
    log_depth = np.log(np.minimum(depth, _FAR_M).astype(np.float32))
    total = np.zeros(depth.shape, np.float32)
    for shift in (1, 3):
        for axis in (0, 1):
            first, second = [slice(None)] * 2, [slice(None)] * 2
            first[axis], second[axis] = slice(None, -shift), slice(shift, None)
            before, after = tuple(first), tuple(second)
            behind = log_depth[after] - log_depth[before]
            total[after] += np.clip(behind, 0.0, _MOST_SHADE)
            total[before] += np.clip(-behind, 0.0, _MOST_SHADE)
    return np.asarray(np.exp(-np.float32(strength) * total))
