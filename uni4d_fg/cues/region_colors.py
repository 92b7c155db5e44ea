"""Regions that move, made to end where colors do.

What appearance and tracks say of a pixel is blurred, and silent where the image is flat: heads and legs are missed, and
strips of background beside a thing are taken along. Inside a region and around it the colors of both tell which pixel
belongs to which, and edges of the image where they part: GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004), as
OpenCV has it. Certain to move are the core of a region and what evidence is sure of; what is thin and was hardly seen
to move has to be told by its colors, or goes.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.moving_regions import disk, working_pixels
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.track_model import Tracks

_BLUR_PX = 2
"""Regions end before what moves does by about this, image px, as evidence is blurred."""
_SEED = 0
"""OpenCV draws the first means of the color models: from the same state in every frame."""


def end_at_colors(
    region: BoolArray,
    image: ImageArray,
    evidence: Float32Array,
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
        evidence: (h, w) log odds that pixels move. Below 0 they do not, and above ``config.color_sure`` within the
            region they do, whatever the color.
        tracks: K tracks; around static ones outside the region nothing moves.
        motion: Which of them move.
        frame: The frame.
        scale: (2,) working pixels per image pixel, x and y.
        config: Its fields ``color_...``, in working pixels.
    """
    size = image.shape[:2]
    wide = cv2.dilate(region.astype(np.uint8), disk(_BLUR_PX))
    small = cv2.resize(wide, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    if not small.any() or config.color_reach_px == 0:
        return region
    near = cv2.dilate(small, disk(config.color_reach_px))
    label = np.full(size, cv2.GC_BGD, np.uint8)
    label[near > 0] = cv2.GC_PR_BGD
    label[small > 0] = cv2.GC_PR_FGD
    core = cv2.erode(small, disk(config.color_core_px)) > 0
    label[core | ((small > 0) & (evidence > config.color_sure))] = cv2.GC_FGD
    at_rest = np.zeros(size, np.uint8)
    at_rest[working_pixels(tracks.uv[motion.static & tracks.visible[:, frame], frame], size, scale)] = 1
    label[(cv2.dilate(at_rest, disk(config.color_track_px)) > 0) & (small == 0)] = cv2.GC_BGD
    label[evidence < 0] = cv2.GC_BGD
    part = _around_region(near, config.color_margin_px)
    inside = label[part].copy()
    if _moves(inside).all():  # no other color to tell them from
        return region
    if not _moves(inside).any():
        return np.zeros_like(region)
    cv2.setRNGSeed(_SEED)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image[part]), inside, None, *models, 1, cv2.GC_INIT_WITH_MASK)
    found = np.zeros(size, np.float32)
    found[part] = _moves(inside)
    full = cv2.resize(found, (region.shape[1], region.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(full > 0.5)


def _moves(label: np.ndarray) -> BoolArray:
    return np.asarray((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD))


def _around_region(near: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of a region and a margin around it."""
    rows, columns = (np.flatnonzero(near.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(0, int(k[0]) - margin), int(k[-1]) + 1 + margin) for k in (rows, columns))  # type: ignore[return-value]
