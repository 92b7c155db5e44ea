r"""The depth cue's scale where a moving object is, from the static scene around it.

A cue errs by scale and shift of its disparity in every frame, and by a field that is smooth over the image. The static
landmarks measure both: s_i = log z_i - log D(uv_i), of which the shift is fitted first. At a dynamic observation the
rest is predicted by the median m of the nearest static ones in the image, of which a part is taken,

    s = lambda(d) m,

that falls with their distance d: a thing that covers much of the image is far from what it is compared with. Neither
lambda nor the error of the prediction is assumed: both are measured, by predicting static s_i from neighbors that are
as far away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, evenly_spread, rows_by_group
from uni4d_fg.geometry.nearest_points import NearestPoints
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.affine_error import SHIFT_SIGMA, fit_affine
from uni4d_fg.slam.stages.observations import Observations

_DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_AWAY = (0.0, 0.02, 0.04, 0.08, 0.16, 0.3)
"""How far static observations are predicted from, as parts of the diagonal that they span."""
_SHIFT_SIGMA = 0.5 * SHIFT_SIGMA
"""Standard deviation of the shift of a frame's disparity, of the median one. Things that move are mostly before what
they are compared with, where a wrong shift costs most: half of what a whole frame's depth is fitted with."""
_FARTHEST = 0.1
"""Least part of the inverse depth that a shift leaves."""
_BETTER = 0.97
"""Part of the frame's error below which a prediction is better than the frame's scale."""
_OUTLIER = 4.0
"""Standard deviations from which on a static observation says nothing of lambda."""


@dataclass(frozen=True)
class LocalScale:
    """Predicted log-scales and how well they predict."""

    log_scale: FloatArray
    """(N,) per queried observation."""
    sigma: float
    """Standard deviation of the chosen prediction on the static scene, from as far away as the queries are from it."""
    frame_sigma: float
    """The same for the frame's scale alone."""

    @property
    def is_local(self) -> bool:
        """Whether the neighborhood predicts better than the frame's scale."""
        return self.sigma < self.frame_sigma


class _OfFrame(NamedTuple):
    """What the static scene of one frame says."""

    query: IntArray
    """(m,) rows of the queries."""
    log_scale: FloatArray
    """(m,) by the frame's affine error alone."""
    around: FloatArray
    """(m,) median of what is left of the nearest static observations ..."""
    distance: FloatArray
    """... and how far they are, px."""
    left: FloatArray
    """(n,) what that error leaves of the static observations."""
    pairs: FloatArray
    """(4, p) what is left of a static observation, the median of others, how far they are, px, and which of
    ``_AWAY`` was meant."""


def predict_log_scale(
    static: Observations,
    static_log_scale: FloatArray,
    frame_log_scale: FloatArray,
    queries: Observations,
    neighbors: int,
    samples: int,
) -> LocalScale:
    """Predict the cue's log-scale at observations of moving points.

    Args:
        static: Observations of landmarks.
        static_log_scale: (S,) log z - log cue of each; NaN where unknown.
        frame_log_scale: (T,) the frames' scales.
        queries: N observations to predict for.
        neighbors: Static observations per prediction; 0 takes the frame's scale.
        samples: Predictions of static observations per frame and direction, at most.
    """
    deviation = static_log_scale - frame_log_scale[static.frame]
    frame_sigma = robust_sigma(deviation[np.isfinite(deviation)])
    whole_frame = LocalScale(frame_log_scale[queries.frame], frame_sigma, frame_sigma)
    if neighbors == 0:
        return whole_frame
    count = len(frame_log_scale)
    usable = np.flatnonzero(np.isfinite(deviation))
    usable_of, queries_of = rows_by_group(static.frame[usable], count), rows_by_group(queries.frame, count)

    def of_frame(frame: int) -> _OfFrame | None:
        known = usable[usable_of[frame]]
        if len(known) <= neighbors:
            return None
        return _of_frame(static.select(known), static_log_scale[known], queries, queries_of[frame], neighbors, samples)

    found = [part for part in map_in_order(of_frame, list(range(count)), thread_count()) if part is not None]
    if not found:
        return whole_frame
    measured = _ByDistance.of(found)
    log_scale, variance = frame_log_scale[queries.frame], np.zeros(len(queries))
    for one in found:
        told = np.isfinite(one.log_scale)  # not where there is no cue
        at = one.distance[told]
        log_scale[one.query[told]] = one.log_scale[told] + np.interp(at, *measured.share) * one.around[told]
        variance[one.query[told]] = np.interp(at, *measured.sigma) ** 2
    asked = variance[variance > 0]
    sigma = float(np.sqrt(asked.mean())) if len(asked) else measured.sigma.value[0]
    return LocalScale(log_scale, sigma, frame_sigma) if sigma < _BETTER * frame_sigma else whole_frame


class _Curve(NamedTuple):
    """Values at distances, px, ascending."""

    distance: FloatArray
    value: FloatArray


class _ByDistance(NamedTuple):
    """How well static observations are predicted by others, by how far those are."""

    share: _Curve
    """lambda"""
    sigma: _Curve
    """Standard deviation of what a prediction misses."""

    @classmethod
    def of(cls, found: list[_OfFrame]) -> _ByDistance:
        spread = robust_sigma(np.concatenate([part.left for part in found]))
        left, predicted, away, meant = np.concatenate([part.pairs for part in found], axis=1)
        usual = _OUTLIER * spread
        sound = (np.abs(left) <= usual) & (np.abs(predicted) <= usual)
        rows = []
        for number in np.unique(meant).tolist():
            here = meant == number
            x, y = predicted[here & sound], left[here & sound]
            share = float(np.clip(y @ x / max(float(x @ x), 1e-300), 0.0, 1.0))
            # Of the sample itself, as its spread is not quite that of all.
            error = robust_sigma(left[here] - share * predicted[here]) / max(robust_sigma(left[here]), 1e-300)
            rows.append((float(np.median(away[here])), share, spread * min(error, 1.0)))
        distance, shares, errors = np.array(sorted(rows)).T
        return cls(_Curve(distance, shares), _Curve(distance, errors))


def _of_frame(
    static: Observations, log_scale: FloatArray, queries: Observations, mine: IntArray, neighbors: int, samples: int
) -> _OfFrame:
    """Compare the queries of a frame, and static observations, with the static ones nearest to them, or farther off."""
    cue = static.depth.astype(np.float64)
    fitted = fit_affine(cue, log_scale + np.log(cue), np.ones(len(cue)), _SHIFT_SIGMA)

    def by_frame(depth: FloatArray) -> FloatArray:
        return fitted.log_depth(depth, _FARTHEST * fitted.scale / depth) - np.log(depth)

    values, uv = log_scale - by_frame(cue), static.uv
    tree = NearestPoints(uv)
    distance, near = tree.find(queries.uv[mine], neighbors)
    around, apart = np.median(values[near], axis=1), np.median(distance.astype(np.float64), axis=1)
    sample = evenly_spread(len(uv), max(1, samples // len(_AWAY)))
    low, high = uv.min(axis=0), uv.max(axis=0)
    pairs = [np.zeros((4, 0))]
    for number, part in enumerate(_AWAY):
        for direction in _DIRECTIONS[: 1 if part == 0.0 else None]:
            at = uv[sample] + part * float(np.hypot(*(high - low))) * direction
            inside = np.flatnonzero(((at >= low) & (at <= high)).all(axis=1))
            _, others = tree.find(at[inside], neighbors + 1)
            # Without the point itself, or else without the one that is farthest.
            own = others == sample[inside, None]
            own[~own.any(axis=1), -1] = True
            others = others[~own].reshape(len(inside), neighbors)
            gaps = np.median(np.linalg.norm(uv[others] - uv[sample[inside], None], axis=2), axis=1)
            meant = np.full(len(inside), float(number))
            pairs.append(np.stack([values[sample[inside]], np.median(values[others], axis=1), gaps, meant]))
    return _OfFrame(mine, by_frame(queries.depth[mine].astype(np.float64)), around, apart, values, np.hstack(pairs))
