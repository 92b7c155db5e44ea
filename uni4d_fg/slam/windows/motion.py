"""Trajectories of moving points from several windows, blended where these overlap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.slam.windows.plan import Window

Arrays = Mapping[str, npt.NDArray[Any]]


def join_motion(windows: list[Window], weights: list[FloatArray], parts: list[Arrays]) -> dict[str, npt.NDArray[Any]]:
    """Return the record of stage 3 for the whole video.

    A point that both windows have in a frame of their overlap goes over from the one to the other; where only one of
    them kept the track, its point stands.

    Args:
        windows: Frames of each window.
        weights: (N,) weight of each window's frames; those of neighbors add up to one.
        parts: Per window: points (m, N, 3), NaN where there is none; observed (m, N); track (m,) numbers in the whole
            video; instance (m,).

    Returns:
        The same for all frames.
    """
    num_frames = windows[-1].stop
    tracks = np.unique(np.concatenate([part["track"] for part in parts])).astype(np.int64)
    total = np.zeros((len(tracks), num_frames, 3))
    weight = np.zeros((len(tracks), num_frames))
    observed = np.zeros((len(tracks), num_frames), dtype=bool)
    instance = np.zeros(len(tracks), dtype=np.int64)
    for window, share, part in zip(windows, weights, parts, strict=True):
        row, frames = np.searchsorted(tracks, part["track"]), slice(window.start, window.stop)
        known: BoolArray = np.asarray(np.isfinite(part["points"]).all(axis=2))
        here = known * share
        total[row, frames] += here[..., None] * np.where(known[..., None], part["points"], 0.0)
        weight[row, frames] += here
        observed[row, frames] |= part["observed"] & known
        instance[row] = part["instance"]
    with np.errstate(invalid="ignore"):
        points = total / weight[..., None]
    return {"points": points, "observed": observed, "track": tracks, "instance": instance}
