"""Trajectories as trails: the step of every point from one frame to the next."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray


def step_segments(points: FloatArray, colors: ImageArray, frame: int) -> tuple[Float32Array, ImageArray]:
    """Return the steps from the frame before to this one; a trail is the steps of several frames together.

    Args:
        points: (M, T, 3) world positions, NaN where unknown.
        colors: (M, 3) RGB per trajectory.
        frame: The frame in which the steps end; frame 0 has none.

    Returns:
        (S, 2, 3) ends of the segments, and (S, 2, 3) RGB; a step of which either end is unknown has no segment.
    """
    if frame < 1:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    ends = points[:, frame - 1 : frame + 1]
    known = np.isfinite(ends).all(axis=(1, 2))
    return ends[known].astype(np.float32), np.repeat(colors[known][:, None], 2, axis=1)
