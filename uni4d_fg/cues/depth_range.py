"""How much depth varies around a pixel: what its depth may be where depth and color do not quite coincide."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, IntArray
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.threads import thread_count, workers_in_order

_FAR = np.float32(1e3)
UNKNOWN_RANGE = 2.0
"""Range of log depth where there is none."""


@dataclass(frozen=True)
class DepthRange:
    """Log depth of one frame with its extremes around every pixel; arrays (H, W)."""

    log_depth: Float32Array
    """The depth itself, the farthest one around it where it is missing, and ``fallback`` where there is none."""
    nearest: Float32Array
    farthest: Float32Array
    """Extremes within the window; equal to ``log_depth`` where there is none."""
    known: BoolArray
    """Depth is known somewhere in the window ..."""
    there: BoolArray
    """... and at the pixel itself."""

    @property
    def spread(self) -> Float32Array:
        """(H, W) range of log depth within the window; where depth is missing, anything is possible."""
        return np.where(self.there, self.farthest - self.nearest, np.float32(UNKNOWN_RANGE))


def depth_range(depth: Float32Array, window_px: int) -> DepthRange:
    """Return the extremes of log depth in a window around every pixel.

    Args:
        depth: (H, W) meters, NaN where missing.
        window_px: Side of the window.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        log_depth = np.log(depth).astype(np.float32)
    there = np.isfinite(log_depth)
    fallback = np.float32(np.median(log_depth[there])) if there.any() else np.float32(0.0)
    window = np.ones((max(window_px, 1), max(window_px, 1)), np.uint8)
    nearest = cv2.erode(np.where(there, log_depth, _FAR), window)
    farthest = cv2.dilate(np.where(there, log_depth, -_FAR), window)
    known = farthest >= nearest
    filled = np.where(there, log_depth, np.where(known, farthest, fallback))
    return DepthRange(
        filled,
        np.where(known, nearest, filled).astype(np.float32),
        np.where(known, farthest, filled).astype(np.float32),
        known,
        there,
    )


def spread_at_tracks(tracks: Tracks, depths: FrameSource[Float32Array], window_px: int) -> Float32Array:
    """Return the range of log depth around every observation, (K, T); :data:`UNKNOWN_RANGE` where not visible."""
    result = np.full(tracks.visible.shape, np.float32(UNKNOWN_RANGE))

    def at_tracks(frame: int) -> tuple[IntArray, Float32Array]:
        seen = np.flatnonzero(tracks.visible[:, frame])
        spread = depth_range(depths[frame], window_px).spread
        column, row = np.floor(tracks.uv[seen, frame] + 0.5).astype(np.int64).T
        height, width = spread.shape
        return seen, spread[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    frames = np.flatnonzero(tracks.visible.any(axis=0)).tolist()
    with workers_in_order(thread_count()) as mapped:
        for frame, (seen, spread) in zip(frames, mapped(at_tracks, frames), strict=True):
            result[seen, frame] = spread
    return result
