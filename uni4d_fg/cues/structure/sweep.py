"""How far a camera turns away from what it saw first."""

from __future__ import annotations

import numpy as np

from uni4d_fg.cues.structure.triangulation import median_per_row
from uni4d_fg.slam.stages.observations import Observations

_SWEPT = 0.5
"""Part of the picture by which its content moves on from which far points tell turns and focal length: 1.0 to 1.5 of
pans, up to 0.36 of other clips. Where a view stays, they would let a thing that passes be the world."""


def sweeps(observations: Observations, num_frames: int, image_size: tuple[int, int]) -> bool:
    """Tell whether a view moves on so far as that of a pan does. Arguments as of :func:`view_sweep`."""
    return view_sweep(observations, num_frames, image_size) > _SWEPT


def view_sweep(observations: Observations, num_frames: int, image_size: tuple[int, int]) -> float:
    """Return how far what is seen moves across the picture over a clip, as a part of its width or height.

    The motion of the median track from frame to frame is added up; the way out and back counts once.

    Args:
        observations: N, sorted by track and frame.
        num_frames: T.
        image_size: (height, width), px.
    """
    track, frame, uv = observations.track, observations.frame, observations.uv
    followed = np.flatnonzero((track[1:] == track[:-1]) & (frame[1:] == frame[:-1] + 1))
    motion = uv[followed + 1] - uv[followed]
    steps = [median_per_row(motion[:, axis], frame[followed], num_frames) for axis in (0, 1)]
    path = np.cumsum(np.nan_to_num(steps), axis=1)
    return float(np.max(np.ptp(path, axis=1) / np.array(image_size[::-1])))
