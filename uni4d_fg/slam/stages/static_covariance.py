"""Covariances of the cameras of a static scene."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS
from uni4d_fg.optim.cluster_robust import Clusters, Spread, clustered_marginals, image_cells
from uni4d_fg.optim.considered import Considered, considered_marginals
from uni4d_fg.optim.marginals import CameraMarginals, camera_marginals
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.stages.observations import Observations


def track_cells(observations: Observations, intrinsics: FloatArray, config: BundleAdjustmentConfig) -> Clusters | None:
    """Put tracks, in ascending order, into clusters by the image cell of their first observation; None if off."""
    if config.covariance_cells == 0:
        return None
    order = np.lexsort([observations.frame, observations.track])
    _, first = np.unique(observations.track[order], return_index=True)
    cells = image_cells(observations.uv[order[first]], intrinsics, config.covariance_cells)
    return Clusters(cells, config.covariance_cells**2)


def static_marginals(
    stage: Stage,
    state: State,
    clusters: Clusters | None,
    carried: Spread | None = None,
    considered: Considered | None = None,
) -> CameraMarginals | None:
    """Return the joint covariance of the cameras of a stage, with or without clusters of landmarks.

    With ``considered`` a variable is held that the stage has free, see :mod:`uni4d_fg.optim.considered`.
    """
    points = stage.problem.eliminated
    if considered is not None and points is not None:
        return considered_marginals(stage.problem, state, stage.solver, clusters, points, considered, carried)
    if clusters is None or points is None:
        return camera_marginals(stage.problem, state, stage.solver, points)
    return clustered_marginals(stage.problem, state, stage.solver, clusters, points, carried)


def considered_focal_lengths(intrinsics: FloatArray, fraction: float, aspect: float) -> Considered:
    """Return given intrinsics (4,) as a constant: focal lengths as uncertain as their prior, principal point exact.

    Args:
        intrinsics: (4,) px.
        fraction: Standard deviation of the focal lengths, as a part of their value.
        aspect: Standard deviation of log(fx / fy).
    """
    focal = np.array([intrinsics[0], intrinsics[1], 0.0, 0.0])
    apart = focal * np.array([0.5, -0.5, 0.0, 0.0])
    return Considered(INTRINSICS, fraction**2 * np.outer(focal, focal) + aspect**2 * np.outer(apart, apart))
