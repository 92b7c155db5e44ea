"""The same facts of a run, computed here without the code that exports it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.results.run import Run


@dataclass
class Seen:
    """Observations that agree with the result, ours: pixel centers at integers."""

    landmark: np.ndarray
    frame: np.ndarray
    uv: np.ndarray
    error: np.ndarray


def seen_landmarks(source: Run) -> Seen:
    """Every used observation of a landmark within the run's bound, found by a plain loop over frames."""
    result, labels = source.reconstruction, source.labelled
    assert labels is not None
    bound = source.config.bundle_adjustment.max_reprojection_px
    fx, fy, cx, cy = result.intrinsics
    parts = []
    for frame, pose in enumerate(result.world_T_cam):
        x, y, z = ((result.landmarks - pose[:3, 3]) @ pose[:3, :3]).T
        uv = labels.tracks.uv[result.landmark_track, frame].astype(np.float64)
        error = np.hypot(fx * x / z + cx - uv[:, 0], fy * y / z + cy - uv[:, 1])
        used = np.flatnonzero((labels.weight[result.landmark_track, frame] > 0) & (z > 0.02) & (error <= bound))
        parts.append((used, np.full(len(used), frame), uv[used], error[used]))
    landmark, frames, uv, error = (np.concatenate(part) for part in zip(*parts, strict=True))
    often = np.bincount(landmark, minlength=len(result.landmarks)) >= 2
    return Seen(landmark[often[landmark]], frames[often[landmark]], uv[often[landmark]], error[often[landmark]])


def mean_reprojection_error(seen: Seen) -> float:
    """The mean over landmarks of the mean over each one's observations, px."""
    return float(np.mean([seen.error[seen.landmark == k].mean() for k in np.unique(seen.landmark)]))
