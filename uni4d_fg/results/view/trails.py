"""Trajectories as trails: line segments from where each point was a few frames ago to where it is."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray

_FADED = 0.25
"""Brightness of the oldest end of a trail."""


def trail_segments(points: FloatArray, colors: ImageArray, frame: int, length: int) -> tuple[Float32Array, ImageArray]:
    """Cut the last ``length`` steps up to a frame into line segments that fade towards the past.

    Args:
        points: (M, T, 3) world positions, NaN where unknown.
        colors: (M, 3) RGB per trajectory.
        frame: The frame in which the trails end.
        length: Steps of a trail; 0 gives none.

    Returns:
        (S, 2, 3) ends of the segments, and (S, 2, 3) RGB; a step of which either end is unknown has no segment.
    """
    first = max(0, frame - length)
    span = points[:, first : frame + 1]
    if span.shape[1] < 2:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    ends = np.stack((span[:, :-1], span[:, 1:]), axis=2)
    brightness = np.linspace(_FADED, 1.0, length + 1)[-span.shape[1] :]
    shade = np.stack((brightness[:-1], brightness[1:]), axis=1)
    shaded = np.rint(colors[:, None, None, :] * shade[None, :, :, None]).astype(np.uint8)
    known = np.isfinite(ends).all(axis=(2, 3))
    return ends[known].astype(np.float32), shaded[known]
