"""Static tracks that became no landmark: how badly their rays meet, which tells what moves from what merely slides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.slam.stages.observations import observations_of

_MIN_OBSERVATIONS = 3
"""Two rays nearly always meet."""
_HUBER_PX = 2.0


def dropped_tracks(labelled: LabelledTracks, scene: Mapping[str, npt.NDArray[Any]]) -> tuple[IntArray, FloatArray]:
    """Return static tracks (D,) that are no landmarks, and the median reprojection error (D,), px, of where they meet.

    The depth cue has no say. Rays that do not meet in front of the cameras have no error: NaN.

    Args:
        labelled: Observations, on the pixels that the scene was solved on.
        scene: Record of stage 2.
    """
    seen = observations_of(labelled, TrackLabel.STATIC).with_min_observations(_MIN_OBSERVATIONS)
    seen = seen.select(~np.isin(seen.track, scene["landmark_track"]))
    if len(seen) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    # Hundreds of milliseconds to load, and most runs need nothing of it.
    from uni4d_fg.cues.structure.triangulation import RayBundle, triangulate

    track, row = seen.rows()
    rays = RayBundle(row, scene["world_T_cam"], seen.frame, seen.uv, scene["intrinsics"], len(track))
    return track, triangulate(rays, _HUBER_PX).error_px
