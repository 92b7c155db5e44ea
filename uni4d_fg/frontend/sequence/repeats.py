"""Frames that repeat the one before: what a change of frame rate leaves in a video.

Tracks point to the candidates, as nothing moves into such a frame while it moves around it; the images decide. Two
pictures of a camera at rest differ by noise and by what moves, a repeated one by its coding alone. Longer runs are
taken for a camera at rest, whose frames do no harm.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.track_model import Tracks

_MOVING_PX = 0.3
"""Median motion of the tracks around a candidate, at least."""
_AT_REST = 0.25
"""Part of it that is left into a candidate, at most."""
_AROUND = 5
"""Frames on either side that count as around."""
_LONGEST = 4
"""Repeats of one picture, at most."""
_BLOCK_PX = 16
_CODING = 2.0
"""Mean difference of gray values that coding leaves in any block of a repeated picture, at most."""
_OF_OTHERS = 0.1
"""The same as a part of the difference from the frames around."""


def repeated_frames(images: FrameSource[ImageArray], tracks: Tracks) -> BoolArray:
    """Return which frames repeat the one before, (T,).

    Args:
        images: T images (H, W, 3) or (H, W), uint8; only those about a candidate are read.
        tracks: K tracks over them.

    Raises:
        InputError: If a frame cannot be read.
    """
    candidate = _without_long_runs(_candidates(_motion(tracks)))
    found = np.zeros(len(candidate), dtype=bool)
    for frame in np.flatnonzero(candidate).tolist():
        before = _difference(images[frame - 1], images[frame])
        if before > _CODING:
            continue
        moved = [_difference(images[t - 1], images[t]) for t in _moving_beside(candidate, frame)]
        # Pictures without any texture differ nowhere, and say nothing.
        found[frame] = bool(moved) and min(moved) > 0.0 and before <= _OF_OTHERS * min(moved)
    return _without_long_runs(found)


def _motion(tracks: Tracks) -> FloatArray:
    """Return the median motion of the tracks into each frame, (T,) px; NaN for the first, and where none is seen."""
    out = np.full(tracks.num_frames, np.nan)
    for t in range(1, tracks.num_frames):
        both = tracks.visible[:, t] & tracks.visible[:, t - 1]
        if both.any():
            step = tracks.uv[both, t].astype(np.float64) - tracks.uv[both, t - 1]
            out[t] = np.median(np.linalg.norm(step, axis=1))
    return out


def _candidates(motion: FloatArray) -> BoolArray:
    """Return the frames (T,) into which tracks rest while they move around them."""
    out = np.zeros(len(motion), dtype=bool)
    for t in range(1, len(motion)):
        around = motion[max(t - _AROUND, 1) : t + _AROUND + 1]
        around = around[np.isfinite(around)]
        if np.isfinite(motion[t]) and len(around) > 1:
            # The upper quartile: up to three in four pictures may be repeats.
            typical = float(np.quantile(around, 0.75))
            out[t] = typical > _MOVING_PX and motion[t] < _AT_REST * typical
    return out


def _without_long_runs(flags: BoolArray) -> BoolArray:
    """Clear runs of more than ``_LONGEST`` flags."""
    out, start = flags.copy(), None
    for t in range(len(flags) + 1):
        if t < len(flags) and flags[t]:
            start = t if start is None else start
        elif start is not None:
            if t - start > _LONGEST:
                out[start:t] = False
            start = None
    return out


def _moving_beside(candidate: BoolArray, frame: int) -> list[int]:
    """Return the nearest frames before and behind that are no candidates, without the first of the video."""
    before = [t for t in range(frame - 1, 0, -1) if not candidate[t]][:1]
    behind = [t for t in range(frame + 1, len(candidate)) if not candidate[t]][:1]
    return before + behind


def _difference(one: ImageArray, other: ImageArray) -> float:
    """Return the largest mean difference of gray values among blocks of two images."""
    difference = cv2.absdiff(one, other)
    gray = difference if difference.ndim == 2 else difference.mean(axis=2)
    height, width = gray.shape
    blocks = (max(width // _BLOCK_PX, 1), max(height // _BLOCK_PX, 1))
    return float(cv2.resize(gray.astype(np.float32), blocks, interpolation=cv2.INTER_AREA).max())
