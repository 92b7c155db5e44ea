"""From evidence per pixel, and tracks that move or do not, to regions that move."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.guided_filter import guided_filter
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.track_model import Tracks

_STATIC_REACH = 0.012
"""A static track denies pixels around it up to this part of the image's diagonal, where evidence says otherwise."""
_FEWEST_MOVING = 2
"""Tracks that have to move in what is left of a region that others deny."""


def track_evidence(
    tracks: Tracks,
    motion: TrackMotion,
    frame: int,
    size: tuple[int, int],
    scale: FloatArray,
    config: MotionMaskConfig,
) -> Float32Array:
    """Spread what the tracks of a frame say over the pixels around them.

    Args:
        tracks: K tracks.
        motion: Which of them move.
        frame: The frame.
        size: (h, w) at working size.
        scale: (2,) working pixels per image pixel, x and y.
        config: Reach of a track, and how much few of them say.

    Returns:
        (h, w) from -1 (static tracks only) over 0 (none, or undecided) to 1 (moving tracks only).
    """
    moving, static = (
        spread_tracks(tracks, which, frame, size, scale, config.track_reach_px)
        for which in (motion.moving, motion.static)
    )
    around = moving + static
    # Seen from the tracks: most pixels may have none.
    usual = float(np.sum(around**2)) / max(float(np.sum(around)), 1e-6)
    undecided = np.float32(config.track_undecided * max(usual, 1.0))
    return ((moving - static) / (around + undecided)).astype(np.float32)


def spread_tracks(
    tracks: Tracks, which: BoolArray, frame: int, size: tuple[int, int], scale: FloatArray, reach_px: float
) -> Float32Array:
    """Return how many of some tracks (K,) are around each pixel (h, w), as a Gaussian of that reach weighs them."""
    seen = which & tracks.visible[:, frame]
    image = np.zeros(size, np.float32)
    np.add.at(image, working_pixels(tracks.uv[seen, frame], size, scale), np.float32(1))
    peak = 2 * np.pi * reach_px**2
    return np.asarray(cv2.GaussianBlur(image, (0, 0), reach_px) * np.float32(peak))


def working_pixels(uv: Float32Array, size: tuple[int, int], scale: FloatArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns (N,) at working size (h, w) of image pixels (N, 2); ``scale`` as above."""
    column, row = ((uv + 0.5) * scale).astype(np.int64).T
    return np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)


def smoothed_evidence(
    evidence: Float32Array, image: ImageArray, radius_px: float, config: MotionMaskConfig
) -> Float32Array:
    """Share evidence (h, w) within surfaces of like color.

    Args:
        evidence: Log odds at working size.
        image: (h, w, 3) uint8 at working size.
        radius_px: How far, working px.
        config: What a like color is.
    """
    guide = np.float32(1 / 255) * image.astype(np.float32)
    return guided_filter(guide, evidence, max(1, round(radius_px)), config.smoothing_contrast)


def moving_region(
    evidence: Float32Array, full_size: tuple[int, int], threshold: float, config: MotionMaskConfig
) -> BoolArray:
    """Take what exceeds a threshold.

    Args:
        evidence: (h, w) log odds at working size.
        full_size: (height, width) of the result.
        threshold: Log odds.
        config: What a small hole is.

    Returns:
        (H, W) True where something moves, small holes filled.
    """
    height, width = full_size
    full = np.asarray(cv2.resize(evidence, (width, height), interpolation=cv2.INTER_LINEAR))
    region: BoolArray = full > threshold
    return _fill_holes(region, round(config.min_area_fraction * height * width))


def _fill_holes(region: BoolArray, below_px: int) -> BoolArray:
    count, part, statistics, _ = cv2.connectedComponentsWithStats((~region).astype(np.uint8), connectivity=4)
    small = statistics[:, cv2.CC_STAT_AREA] < below_px
    small[0] = False
    return np.asarray(region | small[part]) if count > 1 else region


def trusted_components(
    region: BoolArray, tracks: Tracks, motion: TrackMotion, frame: int, config: MotionMaskConfig
) -> BoolArray:
    """Return the connected parts (N, H, W) of a region that are large enough and that their tracks do not deny.

    Where most tracks of a part are static, something that stands has joined what moves: then the pixels count that are
    nearer to a track that moves than to a static one, or far from those.
    """
    parts = _Parts.of(region, tracks, motion, frame, config)
    denied = parts.denied
    if not (denied & (parts.moving >= _FEWEST_MOVING)).any():
        return parts.masks(~denied)
    to_moving, to_static = (_distance(tracks, which, frame, region.shape) for which in (motion.moving, motion.static))
    reach = np.float32(_STATIC_REACH * np.hypot(*region.shape))
    kept = region & ((to_moving < to_static) | (to_static > reach))
    split = _Parts.of(kept & denied[parts.number], tracks, motion, frame, config)
    return np.concatenate([parts.masks(~denied), split.masks(~split.denied & (split.moving >= _FEWEST_MOVING))])


class _Parts(NamedTuple):
    """The connected parts of a region; the first is what is left of the image."""

    number: Int32Array
    """(H, W)."""
    large: BoolArray
    """(N,)."""
    moving: FloatArray
    """(N,) tracks that move, ..."""
    denied: BoolArray
    """... and whether too many are static."""

    @classmethod
    def of(cls, region: BoolArray, tracks: Tracks, motion: TrackMotion, frame: int, config: MotionMaskConfig) -> _Parts:
        height, width = region.shape
        count, number, statistics, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
        moving, static = (_votes(number, count, tracks, which, frame) for which in (motion.moving, motion.static))
        large = statistics[:, cv2.CC_STAT_AREA] >= max(1, round(config.min_area_fraction * height * width))
        large[0] = False
        denied = large & (static > config.max_static_fraction * (moving + static))
        return cls(np.asarray(number, np.int32), np.asarray(large), moving, np.asarray(denied))

    def masks(self, which: BoolArray) -> BoolArray:
        """Return the large ones of some parts (N,), (n, H, W)."""
        return np.asarray(self.number[None] == np.flatnonzero(self.large & which)[:, None, None])


def _distance(tracks: Tracks, which: BoolArray, frame: int, shape: tuple[int, ...]) -> Float32Array:
    """Return how far each pixel (H, W) is from the nearest of some tracks, px."""
    away = np.ones(shape, np.uint8)
    away[_image_pixels(tracks, which, frame, shape)] = 0
    return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, 3))


def grown(masks: BoolArray, radius_px: int) -> BoolArray:
    """Return masks (N, H, W) that reach farther by a radius."""
    if radius_px == 0 or len(masks) == 0:
        return masks
    return np.stack([cv2.dilate(mask.astype(np.uint8), disk(radius_px)) > 0 for mask in masks])


def disk(radius_px: int) -> npt.NDArray[np.uint8]:
    """Return the kernel with which masks grow and shrink by a radius."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2), np.uint8)


def _votes(part: np.ndarray, count: int, tracks: Tracks, which: BoolArray, frame: int) -> FloatArray:
    inside = part[_image_pixels(tracks, which, frame, part.shape)]
    return np.bincount(inside, minlength=count).astype(np.float64)


def _image_pixels(tracks: Tracks, which: BoolArray, frame: int, shape: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the tracks, of some (K,), that a frame (H, W) shows."""
    return working_pixels(tracks.uv[which & tracks.visible[:, frame], frame], (shape[0], shape[1]), np.ones(2))
