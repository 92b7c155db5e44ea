r"""The depth cue's scale where a moving object is, from the static scene around it.

A cue errs by a frame-wide scale and, more weakly, by a field that is smooth over the image. The static
landmarks measure both: s_i = log z_i - log D(uv_i). At a dynamic observation the scale is predicted by the
median of the nearest static s_i in the image. Whether that is better than the frame's scale alone is not
assumed but measured, by predicting static s_i from their neighbors without themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import FloatArray, evenly_spread
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.slam.stages.noise import robust_sigma
from uni4d_fg.slam.stages.observations import Observations


@dataclass(frozen=True)
class LocalScale:
    """Predicted log-scales and how well they predict."""

    log_scale: FloatArray
    """(N,) per queried observation."""
    sigma: float
    """Standard deviation of the chosen prediction on the static scene."""
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
    predicted, errors = np.zeros(len(queries)), [np.zeros(0)]
    threads = thread_count()
    usable = np.flatnonzero(np.isfinite(deviation))
    for frame in range(len(frame_log_scale)):
        known = usable[static.frame[usable] == frame]
        mine = np.flatnonzero(queries.frame == frame)
        if len(known) <= neighbors:
            continue
        # Points spread over an image need no balanced tree, which takes longer to build.
        tree, values = cKDTree(static.uv[known], balanced_tree=False), deviation[known]
        sample = evenly_spread(len(known), samples)
        _, near = tree.query(static.uv[known[sample]], k=neighbors + 1, workers=threads)
        errors.append(values[sample] - np.median(values[near[:, 1:]], axis=1))
        if len(mine):
            _, near = tree.query(queries.uv[mine], k=neighbors, workers=threads)
            predicted[mine] = np.median(values[near.reshape(len(mine), -1)], axis=1)
    sigma = robust_sigma(np.concatenate(errors))
    if not sigma < frame_sigma:
        return whole_frame
    return LocalScale(frame_log_scale[queries.frame] + predicted, sigma, frame_sigma)
