"""Static depth brought to the size of the image: smooth within surfaces, with the cue's detail at edges."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.results.fusion.log_range import log_range
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize

_EDGE = 0.04
"""Change of log depth over a pixel of the working size, from which on there may be an edge."""
_WINDOW = np.ones((3, 3), np.uint8)
_MISSING = -99.0
"""Stands for log depth that is missing: there is an edge beside it."""


def lifted(log_depth: Float32Array, log_cue: Float32Array, cue: Float32Array, size: WorkingSize) -> Float32Array:
    """Return depth (H, W), m, NaN exactly where the cue is.

    Within a surface the coarse map is smooth, and has less noise than one frame's cue. At an edge, the cue has the
    detail: it takes the change that was made to it at working size.

    Args:
        log_depth: (h, w), NaN where missing.
        log_cue: (h, w) the cue, before anything was done to it.
        cue: (H, W) m, the same, NaN where missing.
        size: Of both maps.
    """
    log_depth_range = log_range(np.nan_to_num(log_depth, nan=_MISSING), _WINDOW)
    steep = size.enlarge(log_depth_range)
    smooth = size.enlarge(log_depth)
    depth = np.exp(smooth)
    at = np.flatnonzero((steep > _EDGE) | np.isnan(smooth))
    if at.size:
        change = log_depth - log_cue
        known = change[np.isfinite(change)]
        log_cue_at = np.log(cue.ravel()[at])
        detailed = log_cue_at + size.enlarge(change).ravel()[at]
        share = np.clip(steep.ravel()[at] / np.float32(_EDGE) - 1, 0, 1)
        smooth = smooth.ravel()[at]
        blended = np.where(np.isfinite(smooth), (1 - share) * smooth + share * detailed, detailed)
        # Beside missing depth nothing is known at working size: there the cue has its frame's usual error.
        usual = log_cue_at + np.float32(np.median(known) if known.size else np.nan)
        depth.ravel()[at] = np.exp(np.where(np.isfinite(blended), blended, usual))
    depth[np.isnan(cue)] = np.nan
    return depth
