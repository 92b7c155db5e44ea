"""Tracks that are worse than others: on weak texture, beside an edge, on what sways.

Most tracks of a video keep to their points within a tenth of a pixel or two, and some slide by pixels. With one
standard deviation for all, those that slide count as much as the others and bend the cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.observations import Observations

_OWN_DOF = 2.0
"""Degrees of freedom that a track's residuals are worth for its own variance: the errors of one track are alike from
frame to frame, so that many observations of it tell hardly more than one."""
_LARGEST_SQUARED = 25.0
"""Squared residuals over the variance of all are cut here: single observations are the kernel's."""
_POINT_DOF = 3
"""What the landmark took from its residuals."""


def relative_variance(squared: FloatArray, row: IntArray, prior_dof: float) -> FloatArray:
    """Return the variance of each track over that of all tracks, (M,), as an empirical Bayes estimate.

    The variances are taken for draws from a scaled inverse chi-squared distribution; the estimate is the mean of the
    prior, 1, and of what the track's own residuals say, weighed by their degrees of freedom. Source: Smyth 2004,
    "Linear models and empirical Bayes methods for assessing differential expression in microarray experiments", eq. 6.

    Args:
        squared: (N,) squared norms of residuals (2 components) over the variance that a component has on all tracks.
        row: (N,) track of each, 0 .. M - 1; none without observations.
        prior_dof: Degrees of freedom of the prior; more keep the tracks closer together.
    """
    count = np.bincount(row)
    own = np.bincount(row, np.minimum(squared, _LARGEST_SQUARED)) / np.maximum(2 * count - _POINT_DOF, 1)
    return np.asarray((prior_dof + _OWN_DOF * own) / (prior_dof + _OWN_DOF))


def weigh_by_track(
    residual: FloatArray, row: IntArray, observations: Observations, config: BundleAdjustmentConfig
) -> Observations:
    """Weigh the observations of each track by the inverse of its variance; those of the median track keep theirs.

    Args:
        residual: (N, 2) px.
        row: (N,) track of each, 0 .. M - 1.
        observations: N observations.
        config: Stage 2.
    """
    if config.track_noise_dof is None:
        return observations
    sigma = max(robust_sigma(residual), config.min_reprojection_sigma_px)
    # Weights are inverse variances: with them an observation far from its query frame is no sign of a bad track.
    squared = observations.weight / observations.weight.mean() * np.sum(residual**2, axis=1) / sigma**2
    variance = relative_variance(squared, row, config.track_noise_dof)
    return replace(observations, weight=observations.weight * (np.median(variance) / variance)[row])
