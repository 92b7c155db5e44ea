"""How well the camera's path is known, and what that leaves of the certainty of depth."""

from __future__ import annotations

import math

import numpy as np

from uni4d_fg.arrays import FloatArray

_RIGHT_WITHIN = 0.03
"""Relative error of depth that counts as right, as everywhere in confidence."""
_LEAST_SHARE = 0.1
"""However bad the path: so that of pixels the surer ones can still be told, in the 8 bits that confidence has."""


def path_uncertainty(world_T_cam: FloatArray, pose_covariance: FloatArray | None) -> float:
    """Return the typical standard deviation of camera positions, as a part of the path's length; NaN if not known.

    Args:
        world_T_cam: (T, 4, 4) camera to world.
        pose_covariance: (T, 6, 6) of the poses, rotation first, relative to frame 0.
    """
    path = float(np.linalg.norm(np.diff(world_T_cam[:, :3, 3], axis=0), axis=1).sum())
    if pose_covariance is None or not path > 0.0:
        return math.nan
    variance = np.einsum("nii->n", pose_covariance[1:, 3:, 3:])
    return float(np.sqrt(np.maximum(variance, 0.0).mean())) / path


def share_right(uncertainty: float) -> float:
    """Return the probability that depth is right to 3 % as far as the path goes, whose uncertainty this is.

    Triangulated depth is off by the same part as the distance between the cameras that saw it. 1 where nothing is
    known.
    """
    if not uncertainty > 0.0:  # also NaN
        return 1.0
    return max(math.erf(_RIGHT_WITHIN / (math.sqrt(2.0) * uncertainty)), _LEAST_SHARE)
