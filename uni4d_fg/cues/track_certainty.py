"""How surely the image holds tracks in place, and which of them say that something moves where nothing does.

A tracker slides along edges, and on a plain wall it goes with whatever moves beside it. The position of a patch has the
covariance ``sigma_I^2 J^-1`` with the structure tensor ``J`` of its image (Foerstner and Guelch, ISPRS 1987): large
along an edge, and in any direction where there is nothing to see.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, at_nearest_pixel
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.dense_flow import shrunk_gray, shrunk_size, working_scale
from uni4d_fg.cues.moving_regions import spread_tracks
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.threads import thread_count, workers_in_order

_SIZE_PX = 640
_BLUR_PX, _WINDOW_PX = 1.0, 3.0
"""Standard deviations of the Gaussians over the image and over the products of its gradients, px at that size."""
_NOISE = 8.0
"""Variance of the difference that a tracker leaves, over the number of independent pixels of the window, gray levels^2:
compression and changes of light are more than the noise of a pixel."""
_FLAT = 0.05
"""Added to both squared gradients, (gray levels / px)^2: what no image is flatter than."""
_COARSE_PX, _EVERY = 240, 3
"""Size at which tracks around each other are counted, px, and in which frames."""
_AROUND = 0.015
"""Standard deviation of the Gaussian around a track, as a part of the image's diagonal, ..."""
_MOSTLY = 0.7
"""... within which this part of the tracks must move, too, for one to be believed that agrees with a static scene: on
water all of them do; at depth edges, where tracks slide, others beside them stand still."""


def position_variance(images: FrameSource[ImageArray], tracks: Tracks) -> Float32Array:
    """Return the covariance of the position of tracks, (K, 3) px^2: of x x, x y and y y.

    Args:
        images: T images (H, W, 3) uint8 RGB.
        tracks: K tracks. Structure tensors are averaged over the frames that see them.
    """
    height, width = images[0].shape[:2]
    size = shrunk_size((height, width), working_scale((height, width), _SIZE_PX))
    scale = np.array([size[1] / width, size[0] / height])

    def at_tracks(frame: int) -> Float32Array:
        seen = tracks.visible[:, frame]
        gray = shrunk_gray(images[frame], size).astype(np.float32)
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), _BLUR_PX), np.float32)
        gx, gy = (cv2.Sobel(gray, -1, 1 - axis, axis, ksize=3) / 8 for axis in (0, 1))
        tensor = cv2.GaussianBlur(np.dstack((gx * gx, gx * gy, gy * gy)), (0, 0), _WINDOW_PX)
        return np.asarray(at_nearest_pixel(tensor, (tracks.uv[seen, frame] + 0.5) * scale - 0.5), np.float32)

    total, count = np.zeros((tracks.num_tracks, 3)), np.count_nonzero(tracks.visible, axis=1)
    with workers_in_order(thread_count()) as mapped:
        for frame, tensor in enumerate(mapped(at_tracks, list(range(len(images))))):
            total[tracks.visible[:, frame]] += tensor
    xx, xy, yy = total.T / np.maximum(count, 1)
    xx, yy = xx + _FLAT, yy + _FLAT
    determinant = xx * yy - xy * xy
    (sx, sy) = scale
    variance = np.stack((yy / sx**2, -xy / (sx * sy), xx / sy**2), axis=1) * (_NOISE / determinant)[:, None]
    return np.asarray(variance, np.float32)


def share_of_moving(tracks: Tracks, moving: BoolArray, static: BoolArray, image_size: tuple[int, int]) -> FloatArray:
    """Return which part of the tracks around each one moves, (K,), of those (K,) that move or do not.

    Looked at in every third frame.
    """
    size = shrunk_size(image_size, working_scale(image_size, _COARSE_PX))
    scale = np.array([size[1] / image_size[1], size[0] / image_size[0]])
    reach = _AROUND * float(np.hypot(*size))

    def at_tracks(frame: int) -> Float32Array:
        one, other = (spread_tracks(tracks, which, frame, size, scale, reach) for which in (moving, static))
        share = one / np.maximum(one + other, np.float32(1e-6))
        return at_nearest_pixel(share, (tracks.uv[tracks.visible[:, frame], frame] + 0.5) * scale - 0.5)

    total, count = np.zeros(tracks.num_tracks), np.zeros(tracks.num_tracks)
    frames = list(range(0, tracks.num_frames, _EVERY))
    with workers_in_order(thread_count()) as mapped:
        for frame, share in zip(frames, mapped(at_tracks, frames), strict=True):
            total[tracks.visible[:, frame]] += share
            count[tracks.visible[:, frame]] += 1
    return total / np.maximum(count, 1)


def believed(
    known: BoolArray, motion: TrackMotion, tracks: Tracks, image_size: tuple[int, int], config: MotionMaskConfig
) -> BoolArray:
    """Return which (K,) of the tracks that contradict a static scene by themselves are to be believed.

    Those that agree with a static scene by what the image holds in place are not, unless most around them move as well.
    """
    doubtful = known & (motion.departure < config.static_sigmas)
    if not doubtful.any():
        return known
    share = share_of_moving(tracks, motion.moving | known, motion.static & ~known, image_size)
    return np.asarray(known & ~(doubtful & (share < _MOSTLY)))
