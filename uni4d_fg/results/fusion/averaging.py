r"""Static depth averaged over frames: what several views say about a pixel, where they agree.

A static pixel x of frame t with depth d is carried into frame s by the cameras, where it has depth z' and falls on
x'. There the depth map of frame s says D_s(x'). For small motion the two describe the same surface error, so that

    log d  <-  log d + mean over t and all agreeing s of  log(D_s(x') / z'),

with 0 for frame t itself. A frame agrees where ``|log(D_s(x') / z')|`` is below a bound: beyond it, x is occluded
there, on the border of a thing, or off. Errors that are independent between frames shrink with the root of their
number. Between pixels the inverse of D_s is interpolated, which is exact on planes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray

_OUTSIDE = -1e4
_ALIKE = 0.03
"""Log depths that differ by less are the same."""


class Averaged(NamedTuple):
    """Depth and how many agree on it."""

    depth: Float32Array
    """(H, W) m, NaN exactly where the frame's own is."""
    agreeing: Float32Array
    """(H, W) number of other frames that agree."""
    seeing: Float32Array
    """(H, W) number of other frames that have depth where the pixel falls in them."""
    alike: Float32Array
    """(H, W) number of those whose depth is the same to 3 %."""


def average_over_frames(
    depth: Float32Array,
    world_T_cam: FloatArray,
    others: Iterable[tuple[Float32Array, FloatArray, FloatArray]],
    intrinsics: FloatArray,
    max_disagreement: float,
) -> Averaged:
    """Average one frame's depth with that of other frames.

    Args:
        depth: (H, W) m, NaN where missing or moving.
        world_T_cam: (4, 4) pose of the frame.
        others: Depth (H, W), NaN where missing or moving, pose (4, 4) and intrinsics (4,) px of each
            other frame.
        intrinsics: (4,) px, of the frame.
        max_disagreement: Largest ``|log(D_s / z')|`` at which a frame agrees.

    """
    height, width = depth.shape
    fx, fy, cx, cy = (np.float32(value) for value in intrinsics)
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth]).reshape(3, -1)
    correction = np.zeros(height * width, np.float32)
    count = np.zeros(height * width, np.float32)
    seeing = np.zeros(height * width, np.float32)
    alike = np.zeros(height * width, np.float32)
    for other, pose, camera in others:
        fx, fy, cx, cy = (np.float32(value) for value in camera)
        other_T_cam = np.linalg.solve(pose, world_T_cam).astype(np.float32)
        with np.errstate(invalid="ignore"):
            x, y, z = other_T_cam[:3, :3] @ points + other_T_cam[:3, 3:]
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse = np.where(z > 0, 1.0 / z, np.float32(np.nan))
            seen_u = _inside_or_out(fx * x * inverse + cx)
            seen_v = _inside_or_out(fy * y * inverse + cy)
            inverse_sample = cv2.remap(
                1.0 / other,
                seen_u.reshape(height, width),
                seen_v.reshape(height, width),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=float("nan"),
            )
            difference = np.log(inverse / inverse_sample.reshape(-1))
            agrees = np.abs(difference) < max_disagreement
            alike += np.abs(difference) < _ALIKE
        np.add(correction, difference, out=correction, where=agrees)
        count += agrees
        seeing += np.isfinite(difference)
    result: Float32Array = depth * np.exp(correction / (count + 1)).reshape(height, width)
    return Averaged(result, *(found.reshape(height, width) for found in (count, seeing, alike)))


def _inside_or_out(position: Float32Array) -> Float32Array:
    """Put what has no position outside of every image, in place."""
    position[~np.isfinite(position)] = _OUTSIDE
    return position
