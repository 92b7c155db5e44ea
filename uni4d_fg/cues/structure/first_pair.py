"""The two frames to start from: many common tracks, and parallax that no rotation explains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, evenly_spread
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.two_view import Parallax, parallax
from uni4d_fg.slam.stages.observations import Observations

_BESIDE_A_WALL = 2.0
"""A pair will do, too, if a quarter of the tracks has so many times the parallax that the median needs: the rest may be
a wall."""


@dataclass(frozen=True)
class FramePair:
    """Two frames that share tracks."""

    first: int
    second: int
    parallax: Parallax
    common: int
    """Number of tracks that both see."""


class CommonTracks:
    """Looks up what two frames both see."""

    def __init__(self, observations: Observations, num_frames: int) -> None:
        tracks, row = observations.rows()
        self.index = np.full((num_frames, len(tracks)), -1, dtype=np.int64)
        self.index[observations.frame, row] = np.arange(len(observations))

    def between(self, first: int, second: int) -> tuple[IntArray, IntArray]:
        """Return the rows (N,) of the common tracks' observations in either frame."""
        common = np.flatnonzero((self.index[first] >= 0) & (self.index[second] >= 0))
        return self.index[first, common], self.index[second, common]


def rank_pairs(
    observations: Observations,
    num_frames: int,
    intrinsics: FloatArray,
    config: GeometricDepthConfig,
    *,
    known_focal: bool,
) -> list[FramePair]:
    """Rank pairs of ``sampled_frames`` evenly spaced frames, best first.

    A pair is worth its parallax up to ``start_parallax_px``, times the root of its common tracks: with that
    many, more tracks say more than a longer baseline.

    Args:
        observations: Observations of static tracks.
        num_frames: T.
        intrinsics: (4,) px.
        config: Thresholds.
        known_focal: Whether the focal lengths are exact.
    """
    pairs = []
    for seen in common_pixels(observations, num_frames, config.sampled_frames, config):
        moved = parallax(seen.uv_first, seen.uv_second, intrinsics, known_focal=known_focal)
        pairs.append(FramePair(seen.first, seen.second, moved, seen.common))
    return sorted(pairs, key=lambda pair: -_worth(pair, config))


class CommonPixels(NamedTuple):
    """What two frames both see."""

    first: int
    second: int
    uv_first: FloatArray
    """(n, 2) px of some of their common tracks."""
    uv_second: FloatArray
    """(n, 2) px."""
    common: int
    """Number of tracks that both see."""


def common_pixels(
    observations: Observations, num_frames: int, sampled_frames: int, config: GeometricDepthConfig
) -> Iterator[CommonPixels]:
    """Yield every pair of evenly spaced frames that share enough tracks, with up to ``fitted_tracks`` of those."""
    sampled = evenly_spread(num_frames, sampled_frames).tolist()
    common_tracks = CommonTracks(observations, num_frames)
    for position, first in enumerate(sampled):
        for second in sampled[position + 1 :]:
            a, b = common_tracks.between(first, second)
            if len(a) < config.min_common_tracks:
                break  # tracks only get fewer
            used = evenly_spread(len(a), config.fitted_tracks)
            yield CommonPixels(first, second, observations.uv[a[used]], observations.uv[b[used]], len(a))


def median_motions(observations: Observations, num_frames: int, config: GeometricDepthConfig) -> list[float]:
    """Return how far the median track moves between any two of evenly spaced frames that share enough, px."""
    return [
        float(np.median(np.linalg.norm(seen.uv_second - seen.uv_first, axis=1)))
        for seen in common_pixels(observations, num_frames, config.sampled_frames, config)
    ]


def stands_still(observations: Observations, num_frames: int, config: GeometricDepthConfig) -> bool:
    """Tell whether most tracks stay where they are, which is no parallax at any focal length.

    What moves before such a camera may be parallax of a quarter of the tracks all the same. Scenes of it have no
    baseline, and hardly converge.
    """
    moved = median_motions(observations, num_frames, config)
    return bool(moved) and max(moved) < config.min_parallax_px


def has_parallax(pair: FramePair, config: GeometricDepthConfig) -> bool:
    """Tell whether two frames show parallax enough to start from."""
    least = config.min_parallax_px
    return pair.parallax.median >= least or pair.parallax.upper >= _BESIDE_A_WALL * least


def _worth(pair: FramePair, config: GeometricDepthConfig) -> float:
    return min(pair.parallax.median, config.start_parallax_px) * float(np.sqrt(min(pair.common, config.enough_tracks)))
