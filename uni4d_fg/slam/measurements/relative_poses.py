"""Known relative poses of cameras, loop closures among them, as GTSAM's ``BetweenFactorPose3``."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.config.solver import NativeKernelConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.frontend.measurements.relative_poses import RelativePoses
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage


@dataclass(frozen=True)
class RelativePoseSource:
    """Links pairs of frames that a solve has both."""

    poses: RelativePoses
    kernel: NativeKernelConfig
    fingerprint: str = ""
    is_metric: bool = True
    """Whether their lengths are measured in meters, rather than by the cameras and cues that they join."""

    def noise(self, information: np.ndarray) -> gtsam.noiseModel.Base:
        """Return the noise of one edge, with the kernel."""
        gaussian = gtsam.noiseModel.Gaussian.Information(information)
        estimator = gtsam.noiseModel.mEstimator
        if self.kernel.kind == "quadratic":
            return gaussian
        chosen = {"huber": estimator.Huber, "cauchy": estimator.Cauchy}[self.kernel.kind]
        return gtsam.noiseModel.Robust.Create(chosen(self.kernel.threshold), gaussian)

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Join bundle adjustment; None elsewhere."""
        if not stage.finds_cameras:
            return None
        factors = self.factors(state.numbers(POSE)[:, 0])
        return Addition(factors, is_metric=self.is_metric) if factors else None

    def factors(self, frames: IntArray) -> list[gtsam.BetweenFactorPose3]:
        """Return the factors between some frames (N,)."""
        poses = self.poses
        here = np.flatnonzero(np.isin(poses.first, frames) & np.isin(poses.second, frames))
        return [
            gtsam.BetweenFactorPose3(
                POSE.key(int(poses.first[i])), POSE.key(int(poses.second[i])),
                gtsam.Pose3(poses.first_T_second[i]), self.noise(poses.information[i]),
            )
            for i in here.tolist()
        ]  # fmt: skip
