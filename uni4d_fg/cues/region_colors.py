"""Regions that move, made to end where colors do.

What appearance and tracks say of a pixel is blurred, and silent where the image is flat: heads and legs are missed, and
strips of background beside a thing are taken along. Inside a region and around it the colors of both tell which pixel
belongs to which, and edges of the image where they part: GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004), as
OpenCV has it. Only the core of a region is certain to move: what is thin has to be told by its colors, or goes.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.track_model import Tracks

_BLUR_PX = 2
"""Regions end before what moves does by about this, image px, as evidence is blurred."""
_SEED = 0
"""OpenCV draws the first means of the color models: from the same state in every frame."""


def end_at_colors(
    region: BoolArray,
    image: ImageArray,
    tracks: Tracks,
    motion: TrackMotion,
    frame: int,
    scale: FloatArray,
    config: MotionMaskConfig,
) -> BoolArray:
    """Return a region (H, W) that ends at edges of color near those of the given one.

    Args:
        region: (H, W) True where something moves, by and large.
        image: (h, w, 3) uint8 RGB at working size.
        tracks: K tracks; around static ones outside the region nothing moves.
        motion: Which of them move.
        frame: The frame.
        scale: (2,) working pixels per image pixel, x and y.
        config: Its fields ``color_...``, in working pixels.
    """
    size = image.shape[:2]
    wide = cv2.dilate(region.astype(np.uint8), _disk(_BLUR_PX))
    small = cv2.resize(wide, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    if not small.any() or config.color_reach_px == 0:
        return region
    near = cv2.dilate(small, _disk(config.color_reach_px))
    label = np.full(size, cv2.GC_BGD, np.uint8)
    label[near > 0] = cv2.GC_PR_BGD
    label[small > 0] = cv2.GC_PR_FGD
    label[cv2.erode(small, _disk(config.color_core_px)) > 0] = cv2.GC_FGD
    at_rest = _around(tracks.uv[motion.static & tracks.visible[:, frame], frame], size, scale, config.color_track_px)
    label[at_rest & (small == 0)] = cv2.GC_BGD
    part = _around_region(near, config.color_margin_px)
    inside = label[part].copy()
    moves = (inside == cv2.GC_FGD) | (inside == cv2.GC_PR_FGD)
    if moves.all():  # no other color to tell them from
        return region
    cv2.setRNGSeed(_SEED)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image[part]), inside, None, *models, 1, cv2.GC_INIT_WITH_MASK)
    found = np.zeros(size, np.float32)
    found[part] = (inside == cv2.GC_FGD) | (inside == cv2.GC_PR_FGD)
    full = cv2.resize(found, (region.shape[1], region.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(full > 0.5)


def _disk(radius: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))


def _around(uv: FloatArray, size: tuple[int, int], scale: FloatArray, radius: int) -> BoolArray:
    """Return which working pixels (h, w) are within a radius of image pixels (N, 2)."""
    column, row = np.floor((uv + 0.5) * scale).astype(np.int64).T
    points = np.zeros(size, np.uint8)
    points[np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)] = 1
    return np.asarray(cv2.dilate(points, _disk(radius)) > 0)


def _around_region(near: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of a region and a margin around it."""
    rows, columns = (np.flatnonzero(near.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(0, int(k[0]) - margin), int(k[-1]) + 1 + margin) for k in (rows, columns))  # type: ignore[return-value]
