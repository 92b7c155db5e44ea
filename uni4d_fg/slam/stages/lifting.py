"""Points from depth: the starting values of landmarks, dynamic points and frame scales."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, rows_by_group, sum_rows
from uni4d_fg.geometry.camera import lifted_from, seen_from, unproject
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras


def lift(observations: Observations, cameras: Cameras) -> FloatArray:
    """Lift every observation with its scaled depth cue to the world.

    Args:
        observations: N observations.
        cameras: The cue of frame t is multiplied by exp(log_scale[t]).

    Returns:
        (N, 3) world points, m; NaN where the cue is missing.
    """
    depth = observations.depth * np.exp(cameras.log_scale[observations.frame])
    x: FloatArray = unproject(cameras.intrinsics, observations.uv, depth)
    return lifted_from(cameras.world_T_cam, observations.frame, x)


def mean_per_row(values: FloatArray, weight: FloatArray, row: IntArray, count: int) -> FloatArray:
    """Average (N, 3) values per row, ignoring NaN; rows without a finite value are NaN. Returns (count, 3)."""
    usable: BoolArray = np.asarray(np.isfinite(values).all(axis=1))
    w = np.where(usable, weight, 0.0)
    total = np.bincount(row, w, count)
    sums = sum_rows(w[:, None] * np.where(usable[:, None], values, 0.0), row, count)
    out: FloatArray = np.full((count, 3), np.nan)
    out[total > 0] = sums[total > 0] / total[total > 0, None]
    return out


def frame_log_scales(
    observations: Observations, world_T_cam: FloatArray, points: FloatArray, num_frames: int
) -> FloatArray:
    """Return per frame the median of log(z of the point) - log(cue), (T,); 0 where a frame has none."""
    z = seen_from(world_T_cam, observations.frame, points)[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.log(np.maximum(z, 1e-6)) - np.log(observations.depth)
    out = np.zeros(num_frames)
    known = np.flatnonzero(np.isfinite(ratio))
    for t, rows in enumerate(rows_by_group(observations.frame[known], num_frames)):
        if len(rows):
            out[t] = np.median(ratio[known[rows]])
    return out
