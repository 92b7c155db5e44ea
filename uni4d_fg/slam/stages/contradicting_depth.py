"""Frames whose depth cue contradicts what is known of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.slam.stages.affine_error import fit_affine

_LEAST = 7e-4
"""Error of the log depth from which one cue is compared with others."""
_QUANTILES = (0.5, 0.9)
"""Of the errors at a frame's landmarks. Where most are on one wall the median sees no other depth, and finds a constant
cue as good as any; what stands before the wall tells."""
_MEAN_RATIO = 1.4
"""Times the median frame's that the mean error is at least: of a few landmarks that are nearer than a wall, a sound cue
may miss the depth, and the wall all the better."""
_SPREAD = (0.1, 0.9)
"""Between these quantiles of its log the depth at a frame's landmarks, and the cue there, spread."""
_FLAT = 0.02
"""Part of the median frame's spread below which a cue is flat, ..."""
_DEEP = 0.2
"""... and above which the landmarks of a frame are not."""


def contradicting_frames(seen: Sequence[tuple[FloatArray, FloatArray]], config: FusionConfig) -> list[int]:
    """Return the frames whose cue, but for scale and shift of its disparity, is far worse than that of the others.

    Every frame's cue is compared with the landmarks that it sees. A frame is named if what is left is both
    ``broken_ratio`` times what is left in the median frame, and no less than ``broken_share`` of what a constant depth
    would leave: a cue that still shows which is near and which is far is not broken; and if its mean is above the
    usual, too. Where all is about as far a constant depth errs by no more than other cues do. So what is flat is named,
    too, where landmarks and the cues of other frames are not.

    Args:
        seen: Of each frame, the cue (N,), m, at the landmarks that it sees, and log z - log cue (N,) there; NaN where
            either is unknown.
        config: Thresholds.
    """
    left = np.full((len(_QUANTILES), len(seen)), np.nan)
    constant = np.full((len(_QUANTILES), len(seen)), np.nan)
    mean = np.full(len(seen), np.nan)
    spread = np.full((2, len(seen)), np.nan)
    for frame, (cue, log_scale) in enumerate(seen):
        known = np.isfinite(log_scale) & (cue > 0)
        if np.count_nonzero(known) < config.min_control_points:
            continue
        cue = cue[known]
        log_z = log_scale[known] + np.log(cue)
        fitted = fit_affine(cue, log_z, np.ones(len(log_z)))
        error = np.abs(log_z - fitted.log_depth(cue, 0.0))
        left[:, frame], mean[frame] = np.quantile(error, _QUANTILES), error.mean()
        constant[:, frame] = np.quantile(np.abs(log_z - np.median(log_z)), _QUANTILES)
        low, high = np.quantile([np.log(cue), log_z], _SPREAD, axis=1)
        spread[:, frame] = high - low
    if np.isfinite(left[0]).sum() < config.min_broken_frames:
        return []
    usual = np.maximum(np.nanmedian(left, axis=1, keepdims=True), _LEAST)
    with np.errstate(invalid="ignore"):
        broken = (left > config.broken_ratio * usual) & (left > config.broken_share * constant)
        broken &= mean > _MEAN_RATIO * np.maximum(np.nanmedian(mean), _LEAST)
        of_cue, of_scene = spread / np.maximum(np.nanmedian(spread, axis=1, keepdims=True), 1e-300)
        flat = (of_cue < _FLAT) & (of_scene > _DEEP)
    return np.flatnonzero(broken.any(axis=0) | flat).tolist()
