"""Which tracks are fragments of one point: mutual best among the pairs that look the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.slam.association.appearance import compare
from uni4d_fg.slam.association.candidates import Candidates, find_candidates
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise

_OFFSET_SIGMA_PX = 0.4
"""How well a patch tells where its point is, against the sigmas of the positions."""


@dataclass(frozen=True)
class FragmentSearch:
    """Finds fragments in a solved static scene, see :data:`uni4d_fg.slam.stages.merging.FindFragments`."""

    images: FrameSource[ImageArray]
    """T images in which the tracks were found."""
    raw_uv: Float32Array
    """(K, T, 2) px of the tracks in these images."""
    config: RejoinConfig

    @classmethod
    def of(cls, sequence: Sequence, labelled: LabelledTracks, config: RejoinConfig) -> FragmentSearch | None:
        """Return the search in a sequence's images, with tracks as they lie there; None if it is switched off."""
        return cls(sequence.images, labelled.tracks.uv, config) if config.enabled else None

    def __call__(self, state: State, observations: Observations, noise: StaticNoise) -> IntArray:
        """Return the track that names the point of each landmark, (N,)."""
        tracks, _ = observations.rows()
        pairs = find_candidates(state, observations, noise, self.config)
        seen = compare(self.images, self.raw_uv, state, observations, pairs, self.config)
        alike = (seen.correlation >= self.config.min_correlation) & (seen.offset_px <= self.config.max_offset_px)
        cost = pairs.distance + (seen.offset_px / _OFFSET_SIGMA_PX) ** 2
        # Best by position among all, too: a neighbor must not take the place of one whose patch could not be compared.
        best = mutual_best(pairs, pairs.distance) & mutual_best(pairs, np.where(alike, cost, np.inf))
        order = np.flatnonzero(best)[np.argsort(cost[best], kind="stable")]
        return tracks[group_pairs(pairs.select(order), observations)]


def mutual_best(pairs: Candidates, cost: FloatArray) -> BoolArray:
    """Return which pairs (P,) are the cheapest both of their earlier track and of their later one."""
    result = np.ones(len(pairs), np.bool_)
    for side in (pairs.earlier, pairs.later):
        lowest = np.full(int(side.max(initial=0)) + 1, np.inf)
        np.minimum.at(lowest, side, cost)
        result &= cost <= lowest[side]
    return result & np.isfinite(cost)


def group_pairs(pairs: Candidates, observations: Observations) -> IntArray:
    """Join pairs in their order to groups whose members are not seen together; return each row's lowest, (N,)."""
    tracks, row = observations.rows()
    bounds = np.searchsorted(row, np.arange(len(tracks) + 1))
    name = np.arange(len(tracks))
    members: dict[int, list[int]] = {}
    frames: dict[int, set[int]] = {}

    def frames_of(group: int) -> set[int]:
        if group not in frames:
            frames[group] = set(observations.frame[bounds[group] : bounds[group + 1]].tolist())
        return frames[group]

    for pair in zip(pairs.earlier.tolist(), pairs.later.tolist(), strict=True):
        low, high = sorted(int(name[n]) for n in pair)
        if low == high or frames_of(low) & frames_of(high):
            continue
        moved = members.pop(high, [high])
        members[low] = members.get(low, [low]) + moved
        name[moved] = low
        frames[low] = frames_of(low) | frames.pop(high)
    return name
