"""Numbers that follow from a reconstruction alone: how large the scene is, how certain the cameras are."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.slam.reconstruction import Reconstruction


def scene_depth(reconstruction: Reconstruction) -> float:
    """Return a typical distance between the cameras and what they see, meters (or the units of the run)."""
    points = reconstruction.landmarks
    if not len(points):
        known = np.isfinite(reconstruction.dynamic_points).all(axis=2)
        points = reconstruction.dynamic_points[known]
    if not len(points):
        return 1.0
    center = reconstruction.world_T_cam[:, :3, 3].mean(axis=0)
    return max(float(np.median(np.linalg.norm(points - center, axis=1))), 1e-6)


def pose_sigmas(reconstruction: Reconstruction) -> tuple[FloatArray, FloatArray] | None:
    """Return per frame the standard deviation of position (T,), meters, and of orientation (T,), degrees.

    Each is the root of the trace of its block of ``pose_covariance``; NaN where it is not determined. None if the
    run has no covariance.
    """
    covariance = reconstruction.pose_covariance
    if covariance is None:
        return None
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        rotation = np.sqrt(variances[:, :3].sum(axis=1))
        position = np.sqrt(variances[:, 3:].sum(axis=1))
    return position, np.degrees(rotation)
