"""How much brighter one frame is than others: cameras change their exposure while they record."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, evenly_spread
from uni4d_fg.geometry.camera import project, world_to_camera

_MAX_POINTS, _MIN_POINTS = 1000, 20
_DARK = 0.02
"""Gray values below tell no ratio."""


class Shown(NamedTuple):
    """A frame and where it was taken."""

    gray: Float32Array
    """(h, w), 0 to 1, NaN where something moves."""
    world_T_cam: FloatArray
    """(4, 4)."""
    intrinsics: FloatArray
    """(4,) px, of this size."""


def exposures(own: Shown, others: list[Shown], points: FloatArray) -> list[float]:
    """Return the factors that bring other frames to the brightness of one, as points tell that both show.

    Args:
        own: The frame.
        others: V other ones.
        points: (N, 3) static, world, m.

    Returns:
        V factors; 1 where too few points tell.
    """
    if len(points) < _MIN_POINTS:
        return [1.0] * len(others)
    points = points[evenly_spread(len(points), _MAX_POINTS)]
    here = _gray_at(own, points)
    factors = []
    for other in others:
        there = _gray_at(other, points)
        with np.errstate(invalid="ignore"):
            both = (here > _DARK) & (there > _DARK)
        factors.append(float(np.median(here[both] / there[both])) if np.count_nonzero(both) >= _MIN_POINTS else 1.0)
    return factors


def _gray_at(shown: Shown, points: FloatArray) -> Float32Array:
    """Return the gray values (N,) at which a frame shows points, NaN where it does not."""
    inside = world_to_camera(np.broadcast_to(shown.world_T_cam, (len(points), 4, 4)), points)
    front = inside[:, 2] > 1e-6
    uv = project(shown.intrinsics, np.where(front[:, None], inside, [0.0, 0.0, 1.0])).astype(np.float32)
    values = cv2.remap(
        shown.gray, uv[:, :1], uv[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4
    )
    return np.where(front, values[:, 0], np.float32(np.nan))
