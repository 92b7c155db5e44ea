"""The focal length of a camera that stays in one place, from how it turns.

A pure rotation moves every pixel by ``K R K^-1``, whatever its depth. With a focal length that is wrong, a rotation
about x or y leaves something over, which grows with the square of the angle; even the tremor of a hand is enough. Each
pair of frames votes for the focal length that leaves least, where that is clearly less than what others leave.

Source: Hartley, "Self-calibration from multiple views with a rotating camera" (ECCV 1994), for one unknown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.first_pair import common_pixels
from uni4d_fg.cues.structure.self_calibration import AGREED, MIN_VOTES, least_of
from uni4d_fg.cues.structure.two_view import left_by_rotations, multiples
from uni4d_fg.slam.stages.observations import Observations

_FOCALS = np.geomspace(0.35, 5.0, 68)
"""Focal lengths that are tried, as parts of the longer side of the image: steps of 4 %."""
_SAMPLED_FRAMES = 12
_CLEAR = 1.5
"""At the shortest and the longest focal length, so many times what is left at the best must be left."""
_LEAST_SIGMA = 0.01


class RotationFocal(NamedTuple):
    """A focal length that rotations tell."""

    focal: float
    """px."""
    sigma: float
    """Standard deviation of its log."""


def focal_of_rotations(
    observations: Observations,
    num_frames: int,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: GeometricDepthConfig,
) -> RotationFocal | None:
    """Return the focal length with which rotations explain best what frames see; None where pairs do not agree on one.

    Args:
        observations: N, of static tracks, seen by a camera that only turns.
        num_frames: T.
        image_size: (height, width), px.
        intrinsics: (4,) px, of which the principal point serves.
        config: How many tracks of a pair of frames are needed and taken.
    """
    longer = float(max(image_size))
    tried = multiples(np.array([longer, longer, *intrinsics[2:]]), _FOCALS)
    left = [
        [parallax.median for parallax in left_by_rotations(seen.uv_first, seen.uv_second, tried)]
        for seen in common_pixels(observations, num_frames, _SAMPLED_FRAMES, config)
    ]
    if not left:
        return None
    log_left = np.log(np.maximum(left, 1e-6))
    best = log_left.argmin(axis=1)
    clear = np.minimum(log_left[:, 0], log_left[:, -1]) - log_left.min(axis=1) > np.log(_CLEAR)
    votes = np.log(_FOCALS[best[clear]])
    if len(votes) < MIN_VOTES:
        return None
    lower, upper = np.quantile(votes, [0.25, 0.75])
    if upper - lower > np.log(AGREED):
        return None
    focal = float(np.exp(least_of(np.log(_FOCALS), log_left[clear].mean(axis=0))) * longer)
    return RotationFocal(focal, max(0.5 * float(upper - lower), _LEAST_SIGMA))
