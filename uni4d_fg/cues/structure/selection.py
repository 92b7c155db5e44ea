"""Which tracks find the cameras: long ones, spread over frames and image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, sum_rows
from uni4d_fg.slam.stages.observations import Observations

_COLUMNS, _ROWS = 12, 9
"""Parts of a frame, each of which is to be seen."""
_MIN_OBSERVATIONS = 3
"""Shorter tracks are taken only where there are no longer ones."""
_AT_ONCE = 256
"""Tracks that are looked at together."""


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
    order = np.argsort(-length, kind="stable")
    order = order[length[order] >= min(_MIN_OBSERVATIONS, int(length.max()))]
    picked = np.zeros(len(tracks), dtype=bool)
    picked[_picked(_SeenCells.of(cell, row, length, order), min(count, len(order)))] = True
    result: BoolArray = picked[row]
    return result


@dataclass(frozen=True)
class _SeenCells:
    """The parts of the picture that tracks see, track after track."""

    track: IntArray
    """(m,)."""
    cell: IntArray
    """(n,) parts of all frames, each at most once of one track."""
    start: IntArray
    """(m + 1,) where the parts of each track begin."""

    @classmethod
    def of(cls, cell: IntArray, row: IntArray, length: IntArray, order: IntArray) -> _SeenCells:
        """Bring the parts (N,) that tracks ``row`` (N,), ascending, see into another order (m,) of their tracks."""
        start = np.concatenate(([0], np.cumsum(length[order])))
        first = np.searchsorted(row, order)
        at = np.arange(start[-1]) + np.repeat(first - start[:-1], length[order])
        return cls(order, cell[at], start)


def _picked(seen: _SeenCells, count: int) -> IntArray:
    """Return ``count`` tracks, those first that see what few others do; ever more of them may see the same."""
    filled = np.zeros(int(seen.cell.max(initial=0)) + 1, dtype=np.int64)
    rest = np.ones(len(seen.track), dtype=bool)
    found: list[int] = []
    quota = 1
    while len(found) < count:
        for begin in range(0, len(seen.track), _AT_ONCE):
            start = seen.start[begin : begin + _AT_ONCE + 1]
            wanted = filled[seen.cell[start[0] : start[-1]]] < quota
            half = 2 * np.add.reduceat(wanted, start[:-1] - start[0], dtype=np.int64) >= np.diff(start)
            # Parts only fill: what half of them do not want now, they will not want when its turn comes.
            for place in (begin + np.flatnonzero(half & rest[begin : begin + _AT_ONCE])).tolist():
                cells = seen.cell[seen.start[place] : seen.start[place + 1]]
                if 2 * np.count_nonzero(filled[cells] < quota) >= len(cells):
                    rest[place] = False
                    found.append(int(seen.track[place]))
                    filled[cells] += 1
                    if len(found) >= count:
                        return np.array(found, dtype=np.int64)
        quota *= 2
    return np.array(found, dtype=np.int64)


def picture_cells(uv: FloatArray, image_size: tuple[int, int]) -> IntArray:
    """Return the part of the picture (N,) in which each pixel (N, 2) lies; ``image_size`` is (height, width)."""
    height, width = image_size
    column = np.clip(uv[:, 0] * _COLUMNS / width, 0, _COLUMNS - 1).astype(np.int64)
    line = np.clip(uv[:, 1] * _ROWS / height, 0, _ROWS - 1).astype(np.int64)
    result: IntArray = line * _COLUMNS + column
    return result


def mean_pixels(observations: Observations) -> tuple[FloatArray, IntArray]:
    """Return where each track is seen in the mean, (K, 2) px, and the row of each observation's track, (N,)."""
    tracks, row = observations.rows()
    count = np.bincount(row, minlength=len(tracks))
    return sum_rows(observations.uv, row, len(tracks)) / count[:, None], row
