"""How well the camera's path is known."""

from __future__ import annotations

import math

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.results.evaluate.trajectory import path_length


def path_uncertainty(world_T_cam: FloatArray, pose_covariance: FloatArray | None) -> float:
    """Return the typical standard deviation of camera positions, as a part of the path's length; NaN if not known.

    Args:
        world_T_cam: (T, 4, 4) camera to world.
        pose_covariance: (T, 6, 6) of the poses, rotation first, relative to frame 0.
    """
    path = path_length(world_T_cam)
    if pose_covariance is None or not path > 0.0:
        return math.nan
    variance = np.einsum("nii->n", pose_covariance[1:, 3:, 3:])
    return float(np.sqrt(np.maximum(variance, 0.0).mean())) / path
