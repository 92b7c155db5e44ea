"""How far the depth cue is from saying one thing: do the depths of a static point, seen from many frames, agree?"""

from __future__ import annotations

import numpy as np

from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.proximal import lift_noise
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.stages.structure import mean_lift

_SEEN = 3
"""Frames in which a point must have depth: two depths are as far from their mean for any motion between them."""


def depth_spread(observations: Observations, cameras: Cameras) -> float:
    """Return the robust standard deviation of the log depth about that of the mean point of each track.

    The scale of every frame is taken out first. What all depths of a track share is not seen: it is a lower bound of
    the noise of the cue. NaN without a track that has depth in three frames.

    Args:
        observations: Of static points; those without depth are left out.
        cameras: As stage 1 finds them; errors of theirs add to the spread.
    """
    seen = observations.select(np.isfinite(observations.depth)).with_min_observations(_SEEN)
    _, row = seen.rows()
    noise = lift_noise(seen, mean_lift(seen, cameras)[row], cameras)
    return float("nan") if noise is None else noise.sigma
