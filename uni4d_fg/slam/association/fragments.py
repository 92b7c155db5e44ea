"""Which tracks are fragments of one point: pairs that look the same, and that no other pair contends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.slam.association.appearance import Likeness, compare
from uni4d_fg.slam.association.candidates import Candidates, find_candidates
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise

_OFFSET_SIGMA_PX = 0.4
"""How well a patch tells where its point is, against the sigmas of the positions."""
_UNLIKE = 4.0
"""Added to the cost of a pair whose patches were compared and differ."""


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
        return cls(sequence.images, labelled.tracks.uv, config) if config.enabled != "off" else None

    def __call__(self, state: State, observations: Observations, noise: StaticNoise) -> IntArray:
        """Return the track that names the point of each landmark, (N,)."""
        tracks, _ = observations.rows()
        pairs = find_candidates(state, observations, noise, self.config)
        involved = len(np.unique(np.concatenate([pairs.earlier, pairs.later])))
        if self.config.enabled == "auto" and involved < self.config.auto_part * len(tracks):
            return tracks
        seen = compare(self.images, self.raw_uv, state, observations, pairs, self.config)
        alike = (seen.correlation >= self.config.min_correlation) & (seen.offset_px <= self.config.max_offset_px)
        probability = pair_probability(pairs, association_cost(pairs, seen, self.config))
        best = np.flatnonzero(alike & (probability >= self.config.min_probability))
        order = best[np.argsort(-probability[best], kind="stable")]
        named: IntArray = tracks[group_pairs(pairs.select(order), observations)]
        return named


def association_cost(pairs: Candidates, seen: Likeness, config: RejoinConfig) -> FloatArray:
    """Return minus twice the logarithm of each pair's likelihood, (P,), up to a constant.

    The position's squared Mahalanobis distance and that of the best match of the patches. A pair whose patches cannot
    be compared counts with its position and the mean of the other part: it may still be the right one.
    """
    compared = np.isfinite(seen.offset_px)
    cost: FloatArray = (
        pairs.distance + np.where(compared, np.where(compared, seen.offset_px, 0.0) / _OFFSET_SIGMA_PX, 1.0) ** 2
    )
    cost[compared & (seen.correlation < config.min_correlation)] += _UNLIKE
    return cost


def pair_probability(pairs: Candidates, cost: FloatArray) -> FloatArray:
    """Return how probable each pair is among all that share a track with it, (P,).

    ``L / sum L`` with ``L = exp(-cost / 2)``, over the pairs of either track: above one half it is the best of both,
    so that what passes is one-to-one. Source: joint probabilistic data association, Fortmann et al. 1983.
    """
    likelihood = np.exp(-0.5 * cost)
    total = sum(np.bincount(side, likelihood)[side] for side in (pairs.earlier, pairs.later)) - likelihood
    result: FloatArray = likelihood / np.maximum(total, np.finfo(np.float64).tiny)
    return result


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
