"""Weights of static observations from what they leave over: of blurred frames, then of tracks that slide."""

from __future__ import annotations

from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.slam.stages.frame_noise import weigh_by_frame
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.static_outliers import reprojection_residual
from uni4d_fg.slam.stages.track_noise import weigh_by_track


def weigh_by_residuals(state: State, observations: Observations, config: BundleAdjustmentConfig) -> Observations:
    """Return the observations of the landmarks of a solved state with the weights that a further solve gives them."""
    _, row = observations.rows()
    residual = reprojection_residual(state, observations, row)
    observations = weigh_by_frame(residual, observations, len(state[POSE]), config)
    return weigh_by_track(residual, row, observations, config)
