"""Tracks that are fragments of one static point, as one landmark while a solve lasts.

The point of a group is named by its lowest track and has the observations of all. Afterwards every track has its name
back, at the position of the point, so that whoever looks a track up finds it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.slam.stages.lifting import mean_per_row
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise, StaticScene

FindFragments = Callable[[State, Observations, StaticNoise], IntArray]
"""From a solved static scene to the track (N,) that each of its landmarks, in ascending order of track, is part of:
itself, or the lowest track of its group. The tracks of a group are not seen in a common frame."""


@dataclass(frozen=True)
class MergedTracks:
    """Which observation came from which track."""

    track: IntArray
    """(N,) of each observation before the merge."""
    frame: IntArray
    """(N,)."""
    point: IntArray
    """(N,) track that names the point of each observation."""

    @property
    def joined(self) -> int:
        """Number of tracks that became part of another."""
        return len(np.unique(self.track)) - len(np.unique(self.point))

    def split(self, scene: StaticScene) -> StaticScene:
        """Return the scene with the tracks' own names: one landmark per track, at its point."""
        seen = scene.observations
        shared = np.unique(self.point[self.point != self.track])
        ours, theirs = np.isin(self.point, shared), np.isin(seen.track, shared)
        frames = 1 + int(self.frame.max(initial=0))
        key = self.point[ours] * frames + self.frame[ours]
        order = np.argsort(key, kind="stable")
        own = seen.track.copy()
        own[theirs] = self.track[ours][order][
            np.searchsorted(key[order], seen.track[theirs] * frames + seen.frame[theirs])
        ]
        tracks, first = np.unique(own, return_index=True)
        landmark = np.searchsorted(scene.landmark_track, seen.track[first])
        seen = replace(seen, track=own)
        return replace(
            scene, landmarks=scene.landmarks[landmark], landmark_track=tracks,
            landmark_error=scene.landmark_error[landmark], observations=seen.select(_order(seen)), joined=self.joined,
        )  # fmt: skip


def merge_tracks(state: State, observations: Observations, name: IntArray) -> tuple[State, Observations, MergedTracks]:
    """Make one landmark of each group, at the mean of its members by the weight of their observations.

    Args:
        state: Landmarks named by track, ascending.
        observations: Their observations.
        name: (N,) track that names the point of each landmark.
    """
    _, row = observations.rows()
    weight = np.bincount(row, observations.weight, len(name)).astype(np.float64)
    points, group = np.unique(name, return_inverse=True)
    landmarks = mean_per_row(state[LANDMARK], weight, group, len(points))
    point = name[row]
    renamed = replace(observations, track=point)
    merged = State({**state.arrays, LANDMARK: landmarks}, {**state.index, LANDMARK: points})
    return merged, renamed.select(_order(renamed)), MergedTracks(observations.track, observations.frame, point)


def _order(observations: Observations) -> IntArray:
    frames = 1 + int(observations.frame.max(initial=0))
    return np.argsort(observations.track * frames + observations.frame, kind="stable")
