"""Track observations as flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array, IntArray, evenly_spread
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel


@dataclass(frozen=True)
class Observations:
    """N observations, sorted by track and then by frame."""

    track: IntArray
    """(N,) index in the labelled tracks."""
    frame: IntArray
    """(N,)."""
    uv: FloatArray
    """(N, 2) px."""
    depth: FloatArray
    """(N,) depth cue, m; NaN where missing."""
    weight: FloatArray
    """(N,) above 0: the inverse of the variance, relative to an observation in a track's query frame."""

    def __len__(self) -> int:
        return len(self.track)

    def select(self, keep: BoolArray | IntArray | slice) -> Observations:
        """Return the observations picked by a mask, by indices or by a slice."""
        return Observations(self.track[keep], self.frame[keep], self.uv[keep], self.depth[keep], self.weight[keep])

    def with_min_observations(self, count: int) -> Observations:
        """Drop the observations of tracks that have fewer than ``count``."""
        if len(self) == 0:
            return self
        return self.select(np.bincount(self.track)[self.track] >= count)

    def thinned(self, count: int) -> BoolArray:
        """Tell which observations (N,) are of evenly spread tracks that have about ``count`` of them together."""
        tracks, row = self.rows()
        chosen = np.zeros(len(tracks), dtype=bool)
        chosen[evenly_spread(len(tracks), max(1, len(tracks) * count // max(len(self), 1)))] = True
        return np.asarray(chosen[row])

    def parted(self, count: int) -> tuple[Observations, Observations, IntArray]:
        """Return those that :meth:`thinned` chooses, the others, and the rows of the chosen tracks among all, (M,)."""
        chosen = self.thinned(count)
        return self.select(chosen), self.select(~chosen), np.unique(self.rows()[1][chosen])

    def table(self, which: BoolArray, shape: tuple[int, ...]) -> BoolArray:
        """Return some of the observations (N,) as a table of tracks and frames, (K, T) ``shape``."""
        out = np.zeros(shape, dtype=bool)
        out[self.track[which], self.frame[which]] = True
        return out

    @classmethod
    def joined(cls, parts: Sequence[Observations]) -> Observations:
        """Return the observations of several parts that share no track."""
        arrays = {field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)}
        return cls(**arrays).select(np.argsort(arrays["track"], kind="stable"))

    def rows(self) -> tuple[IntArray, IntArray]:
        """Return the distinct tracks (M,), ascending, and the row of each observation among them (N,)."""
        if (self.track[1:] < self.track[:-1]).any():
            tracks, row = np.unique(self.track, return_inverse=True)
            return tracks, row.astype(np.int64)
        first = np.ones(len(self), dtype=bool)
        np.not_equal(self.track[1:], self.track[:-1], out=first[1:])
        return self.track[first], np.cumsum(first, dtype=np.int64) - 1


def observations_of(labelled: LabelledTracks, *labels: TrackLabel) -> Observations:
    """Collect the trusted observations (weight > 0) of all tracks with one of the labels."""
    wanted = np.isin(labelled.label, [int(label) for label in labels])
    track, frame = np.nonzero((labelled.weight > 0) & wanted[:, None])
    return Observations(
        track.astype(np.int64),
        frame.astype(np.int64),
        labelled.tracks.uv[track, frame].astype(np.float64),
        labelled.depth[track, frame].astype(np.float64),
        labelled.weight[track, frame].astype(np.float64),
    )


def weigh_by_drift(observations: Observations, query_frame: Int32Array, drift_frames: float) -> Observations:
    """Lower the weight of observations far from their track's query frame: ``w / (1 + |t - q| / drift_frames)``.

    A tracker that follows a point from frame to frame accumulates a random walk, whose variance grows
    linearly with the number of steps.

    Args:
        observations: N observations.
        query_frame: (K,) frame in which each track was started.
        drift_frames: Steps after which the variance has doubled.
    """
    steps = np.abs(observations.frame - query_frame[observations.track])
    return replace(observations, weight=observations.weight / (1.0 + steps / drift_frames))
