"""Frames whose observations are worse than those of others: blurred ones, out of focus, with the shutter open long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import FloatArray, rows_by_group
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.observations import Observations

_ENOUGH = 20
"""Observations of a frame from which its noise can be told."""
_AROUND = 4
"""Frames on either side with which a frame is compared: what changes slowly is no blur."""


def relative_noise(residual: FloatArray, frame: np.ndarray, num_frames: int, floor_px: float = 0.0) -> FloatArray:
    """Return the noise of each frame over that of the frames beside it, (T,); 1 where too little is seen.

    Args:
        residual: (N, 2) px.
        frame: (N,) frame of each.
        num_frames: T.
        floor_px: Noise below this is taken for as much.
    """
    parts = [residual[rows] for rows in rows_by_group(frame, num_frames)]
    sigma = np.array([robust_sigma(part) if len(part) >= _ENOUGH else np.nan for part in parts])
    ratio = np.ones(num_frames)
    for t in np.flatnonzero(np.isfinite(sigma)).tolist():
        beside = [part[np.isfinite(part)] for part in (sigma[max(t - _AROUND, 0) : t], sigma[t + 1 : t + 1 + _AROUND])]
        # The worse side counts: noise that grows along a video, or steps up, is no blur.
        typical = max([float(np.median(part)) for part in beside if len(part)] + [floor_px])
        ratio[t] = sigma[t] / typical if typical > 0 else 1.0
    return ratio


def weigh_by_frame(
    residual: FloatArray, observations: Observations, num_frames: int, config: BundleAdjustmentConfig
) -> Observations:
    """Lower the weights in frames whose residuals (N, 2), px, exceed ``blurred_frames`` times those of frames beside.

    Their variance is then taken for what the residuals say; all other frames keep their weights as they are.
    """
    if config.blurred_frames is None:
        return observations
    ratio = relative_noise(residual, observations.frame, num_frames, config.min_reprojection_sigma_px)
    factor = np.where(ratio > config.blurred_frames, np.maximum(ratio, 1.0) ** -2.0, 1.0)
    if (factor == 1.0).all():
        return observations
    return replace(observations, weight=observations.weight * factor[observations.frame])
