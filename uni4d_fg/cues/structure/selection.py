"""Which tracks find the cameras: long ones, spread over frames and image."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.slam.stages.observations import Observations

_COLUMNS, _ROWS = 12, 9
"""Parts of a frame, each of which is to be seen."""
_MIN_OBSERVATIONS = 3
"""Shorter tracks are taken only where there are no longer ones."""


def spread_tracks(observations: Observations, image_size: tuple[int, int], count: int) -> BoolArray:
    """Pick about ``count`` tracks so that every part of every frame is seen by some, long ones first.

    Args:
        observations: N observations, sorted by track.
        image_size: (height, width), px.
        count: Number of tracks wanted.

    Returns:
        (N,) which observations belong to the tracks picked.
    """
    tracks, row = observations.rows()
    length = np.bincount(row, minlength=len(tracks))
    if len(tracks) <= count:
        return np.ones(len(observations), dtype=bool)
    cell = observations.frame * _ROWS * _COLUMNS + picture_cells(observations.uv, image_size)
    start = np.searchsorted(row, np.arange(len(tracks) + 1))
    order = np.argsort(-length, kind="stable")
    order = order[length[order] >= min(_MIN_OBSERVATIONS, int(length.max()))]
    filled = np.zeros(int(cell.max()) + 1, dtype=np.int64)
    picked = np.zeros(len(tracks), dtype=bool)
    quota = 1
    while picked.sum() < min(count, len(order)):
        for track in order[~picked[order]].tolist():
            cells = cell[start[track] : start[track + 1]]
            # Half of what it sees is still wanted there.
            if 2 * np.count_nonzero(filled[cells] < quota) >= len(cells):
                picked[track] = True
                filled[cells] += 1
                if picked.sum() >= count:
                    break
        quota *= 2
    result: BoolArray = picked[row]
    return result


def picture_cells(uv: FloatArray, image_size: tuple[int, int]) -> IntArray:
    """Return the part of the picture (N,) in which each pixel (N, 2) lies; ``image_size`` is (height, width)."""
    height, width = image_size
    column = np.clip(uv[:, 0] * _COLUMNS / width, 0, _COLUMNS - 1).astype(np.int64)
    line = np.clip(uv[:, 1] * _ROWS / height, 0, _ROWS - 1).astype(np.int64)
    result: IntArray = line * _COLUMNS + column
    return result
