r"""The depth cue's scale where a moving object is, from the static scene around it.

A cue errs by a frame-wide scale and, more weakly, by a field that is smooth over the image. The static
landmarks measure both: s_i = log z_i - log D(uv_i). At a dynamic observation the scale is predicted by the
median of the nearest static s_i in the image. Whether that is better than the frame's scale alone is not
assumed but measured, by predicting static s_i from neighbors that are as far away as the static scene is from the
moving points: a thing that covers much of the image is far from what it is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, evenly_spread, rows_by_group
from uni4d_fg.geometry.nearest_points import NearestPoints
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.observations import Observations

_DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


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
        samples: Static observations per frame on which the prediction is measured, at most.
    """
    deviation = static_log_scale - frame_log_scale[static.frame]
    frame_sigma = robust_sigma(deviation[np.isfinite(deviation)])
    whole_frame = LocalScale(frame_log_scale[queries.frame], frame_sigma, frame_sigma)
    if neighbors == 0:
        return whole_frame
    count = len(frame_log_scale)
    usable = np.flatnonzero(np.isfinite(deviation))
    usable_of, queries_of = rows_by_group(static.frame[usable], count), rows_by_group(queries.frame, count)

    def of_frame(frame: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the queries of a frame, what is predicted for them, and errors of predictions on the static scene."""
        known, mine = usable[usable_of[frame]], queries_of[frame]
        if len(known) <= neighbors:
            return mine[:0], np.zeros(0), np.zeros(0)
        tree, values = NearestPoints(static.uv[known]), deviation[known]
        sample = evenly_spread(len(known), samples)
        predicted, away = np.zeros(len(mine)), 0.0
        if len(mine):
            distance, near = tree.find(queries.uv[mine], neighbors)
            predicted = np.median(values[near], axis=1)
            away = float(np.median(distance[:, 0]))
        uv, errors = static.uv[known], [np.zeros(0)]
        for direction in _DIRECTIONS:
            at = uv[sample] + away * direction
            inside = np.flatnonzero(((at >= uv.min(axis=0)) & (at <= uv.max(axis=0))).all(axis=1))
            if not len(inside):
                continue
            _, near = tree.find(at[inside], neighbors + 1)
            # Without the point itself, or else without the one that is farthest.
            own = near == sample[inside, None]
            own[~own.any(axis=1), -1] = True
            others = values[near[~own].reshape(len(inside), neighbors)]
            errors.append(values[sample[inside]] - np.median(others, axis=1))
            if away == 0.0:
                break
        return mine, predicted, np.concatenate(errors)

    predicted, errors = np.zeros(len(queries)), [np.zeros(0)]
    for mine, found, missed in map_in_order(of_frame, list(range(count)), thread_count()):
        predicted[mine] = found
        errors.append(missed)
    sigma = robust_sigma(np.concatenate(errors))
    if not sigma < frame_sigma:
        return whole_frame
    return LocalScale(frame_log_scale[queries.frame] + predicted, sigma, frame_sigma)
