"""Which tracks disagree with what most of the picture does, before any camera is known.

Between frames a few steps apart, the epipolar geometry that most of the picture agrees on is found robustly. Every part
of the picture has the same say, whatever its texture: a person in a patterned shirt close to the camera may hold more
tracks than the room. No focal length is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.consensus import fundamental_matrix
from uni4d_fg.cues.structure.first_pair import CommonTracks
from uni4d_fg.cues.structure.selection import picture_cells
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.slam.stages.observations import Observations

_CONFIDENCE = 0.999
_MIN_PAIRS = 8
"""Tracks that two frames must share: one more than a fundamental matrix takes."""
_PAIRS_PER_STEP = 40
"""Pairs of frames at most that each step looks at, spread over the video."""


@dataclass(frozen=True)
class EpipolarGeometry:
    """What most of the picture does between pairs of frames."""

    outlier: BoolArray
    """(M,) tracks that disagree with it in most of the pairs of frames that see them."""
    fundamental: FloatArray
    """(P, 3, 3) fundamental matrices of the pairs, from pixels of the earlier frame to lines in the later one."""
    left_px: float
    """Median distance of what pairs of frames share from it, px; NaN without pairs."""


def epipolar_geometry(
    observations: Observations, num_frames: int, image_size: tuple[int, int], config: GeometricDepthConfig
) -> EpipolarGeometry:
    """Find the epipolar geometry of most of the picture between frames a few steps apart.

    Args:
        observations: N observations of M tracks.
        num_frames: T.
        image_size: (height, width), px.
        config: Its fields ``epipolar_...``.
    """
    common = CommonTracks(observations, num_frames)
    tracks, row = observations.rows()
    cell = picture_cells(observations.uv, image_size)
    agreed, tested = np.zeros(len(tracks)), np.zeros(len(tracks))
    steps = sorted({min(step, num_frames - 1) for step in config.epipolar_steps})
    pairs = [
        (first, first + step)
        for step in steps
        for first in range(0, num_frames - step, max(1, step // 2, (num_frames - step) // _PAIRS_PER_STEP))
    ]

    def agreement(pair: tuple[int, int]) -> tuple[IntArray, FloatArray, FloatArray] | None:
        a, b = common.between(*pair)
        matrix = _agreed_on(observations.uv[a], observations.uv[b], cell[a], config)
        if matrix is None:
            return None
        return row[a], _distances(matrix, observations.uv[a], observations.uv[b]), matrix

    matrices, distances = [], []
    for found in map_in_order(agreement, pairs, thread_count()):
        if found is not None:
            tested[found[0]] += 1
            agreed[found[0]] += found[1] <= config.epipolar_px
            distances.append(found[1])
            matrices.append(found[2])
    outlier = np.asarray((tested > 0) & (agreed < 0.5 * tested))
    left_px = float(np.median(np.concatenate(distances))) if distances else float("nan")
    return EpipolarGeometry(outlier, np.array(matrices).reshape(-1, 3, 3), left_px)


def _agreed_on(
    first: FloatArray, second: FloatArray, cell: IntArray, config: GeometricDepthConfig
) -> FloatArray | None:
    """Return the fundamental matrix (3, 3) of pixel pairs (N, 2) that most cells agree on, or None."""
    # No more from a part with much texture than most parts have.
    usual = int(np.percentile(np.unique(cell, return_counts=True)[1], 25)) if len(cell) else 1
    used = _balanced(cell, max(1, min(config.epipolar_per_cell, usual)))
    if len(used) < _MIN_PAIRS:
        return None
    return fundamental_matrix(first[used], second[used], config.epipolar_px, _CONFIDENCE, config.two_view_trials)


def _distances(matrix: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return Sampson's distance (N,) px of pixel pairs (N, 2) from an epipolar geometry."""
    a, b = (np.concatenate([uv, np.ones((len(uv), 1))], axis=1) for uv in (first, second))
    line, back = a @ matrix.T, b @ matrix
    slope = np.sqrt(line[:, 0] ** 2 + line[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    result: FloatArray = np.abs(np.sum(b * line, axis=1)) / np.maximum(slope, 1e-12)
    return result


def _balanced(cell: IntArray, count: int) -> IntArray:
    """Return indices of at most ``count`` entries of each cell, evenly spread over it, ascending."""
    order = np.argsort(cell, kind="stable")
    _, start, size = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.arange(len(cell)) - np.repeat(start, size)
    size = np.repeat(size, size)
    # Entry k of n is taken when floor(k m / n) changes.
    share = np.minimum(count / size, 1.0)
    taken = np.floor((rank + 1) * share + 1e-9) > np.floor(rank * share + 1e-9)
    return np.sort(order[taken])
