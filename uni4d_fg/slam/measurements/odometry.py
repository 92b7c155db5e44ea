"""Odometry as GTSAM's ``BetweenFactorPose3`` between the frames that a solve has."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.frontend.measurements.odometry import Odometry
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage


@dataclass(frozen=True)
class OdometrySource:
    """Links every two successive frames of a solve by the motion between them, over left out frames too."""

    odometry: Odometry
    fingerprint: str = ""

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Join bundle adjustment; None elsewhere."""
        if not stage.finds_cameras:
            return None
        _, entry, _ = np.intersect1d(self.odometry.frame, state.numbers(POSE)[:, 0], return_indices=True)
        factors = []
        for first, last in zip(entry[:-1].tolist(), entry[1:].tolist(), strict=True):
            motion, covariance = self.odometry.between(first, last)
            here, there = (POSE.key(int(self.odometry.frame[i])) for i in (first, last))
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
            factors.append(gtsam.BetweenFactorPose3(here, there, gtsam.Pose3(motion), noise))
        return Addition(factors) if factors else None
