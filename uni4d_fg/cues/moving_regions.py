"""From evidence per pixel, and tracks that move or do not, to regions that move."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.guided_filter import guided_filter
from uni4d_fg.cues.track_motion import TrackMotion
from uni4d_fg.frontend.track_model import Tracks


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
        _splat(tracks, which, frame, size, scale, config.track_reach_px) for which in (motion.moving, motion.static)
    )
    around = moving + static
    # Seen from the tracks: most pixels may have none.
    usual = float(np.sum(around**2)) / max(float(np.sum(around)), 1e-6)
    undecided = np.float32(config.track_undecided * max(usual, 1.0))
    return ((moving - static) / (around + undecided)).astype(np.float32)


def _splat(
    tracks: Tracks, which: BoolArray, frame: int, size: tuple[int, int], scale: FloatArray, reach_px: float
) -> Float32Array:
    seen = which & tracks.visible[:, frame]
    image = np.zeros(size, np.float32)
    np.add.at(image, working_pixels(tracks.uv[seen, frame], size, scale), np.float32(1))
    peak = 2 * np.pi * reach_px**2
    return np.asarray(cv2.GaussianBlur(image, (0, 0), reach_px) * np.float32(peak))


def working_pixels(uv: Float32Array, size: tuple[int, int], scale: FloatArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns (N,) at working size (h, w) of image pixels (N, 2); ``scale`` as above."""
    column, row = ((uv + 0.5) * scale).astype(np.int64).T
    return np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)


def moving_region(
    evidence: Float32Array, image: ImageArray, full_size: tuple[int, int], threshold: float, config: MotionMaskConfig
) -> BoolArray:
    """Smooth evidence within surfaces of like color and take what exceeds the threshold.

    Args:
        evidence: (h, w) log odds at working size.
        image: (h, w, 3) uint8 at working size.
        full_size: (height, width) of the result.
        threshold: Log odds.
        config: Smoothing.

    Returns:
        (H, W) True where something moves, small holes filled.
    """
    height, width = full_size
    radius = max(1, round(config.smoothing_px * evidence.shape[1] / width))
    smooth = guided_filter(np.float32(1 / 255) * image.astype(np.float32), evidence, radius, config.smoothing_contrast)
    full = np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR))
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
    """Return the connected parts (N, H, W) of a region that are large enough and that their tracks do not deny."""
    height, width = region.shape
    count, part, statistics, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
    votes = [_votes(part, count, tracks, which, frame) for which in (motion.moving, motion.static)]
    large = statistics[:, cv2.CC_STAT_AREA] >= max(1, round(config.min_area_fraction * height * width))
    denied = votes[1] > config.max_static_fraction * (votes[0] + votes[1])
    kept = np.flatnonzero(large & ~denied)
    kept = kept[kept > 0]
    return np.asarray(part[None] == kept[:, None, None])


def grown(masks: BoolArray, radius_px: int) -> BoolArray:
    """Return masks (N, H, W) that reach farther by a radius."""
    if radius_px == 0 or len(masks) == 0:
        return masks
    return np.stack([cv2.dilate(mask.astype(np.uint8), disk(radius_px)) > 0 for mask in masks])


def disk(radius_px: int) -> npt.NDArray[np.uint8]:
    """Return the kernel with which masks grow and shrink by a radius."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2), np.uint8)


def _votes(part: np.ndarray, count: int, tracks: Tracks, which: BoolArray, frame: int) -> FloatArray:
    seen = which & tracks.visible[:, frame]
    column, row = np.floor(tracks.uv[seen, frame] + 0.5).astype(np.int64).T
    height, width = part.shape
    inside = part[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return np.bincount(inside, minlength=count).astype(np.float64)
