"""Known relative poses of cameras, loop closures among them, as GTSAM's ``BetweenFactorPose3``."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.frontend.measurements.relative_poses import RelativePoses
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage


@dataclass(frozen=True)
class RelativePoseSource:
    """Links pairs of frames that a solve has both.

    Raises:
        ConfigError: On construction, if GTSAM has no such kernel.
    """

    poses: RelativePoses
    kernel: KernelConfig
    fingerprint: str = ""
    is_metric: bool = True
    """Whether their lengths are measured in meters, rather than by the cameras and cues that they join."""

    def __post_init__(self) -> None:
        self.noise(np.eye(6))

    def noise(self, information: np.ndarray) -> gtsam.noiseModel.Base:
        """Return the noise of one edge, with the kernel."""
        gaussian = gtsam.noiseModel.Gaussian.Information(information)
        estimator = gtsam.noiseModel.mEstimator
        if self.kernel.kind == "quadratic":
            return gaussian
        if self.kernel.kind == "huber":
            return gtsam.noiseModel.Robust.Create(estimator.Huber(self.kernel.threshold), gaussian)
        if self.kernel.kind == "cauchy":
            return gtsam.noiseModel.Robust.Create(estimator.Cauchy(self.kernel.threshold), gaussian)
        raise ConfigError(
            f"measurements.relative_poses_kernel.kind={self.kernel.kind}: relative poses are GTSAM's own factors; "
            "choose 'quadratic', 'huber' or 'cauchy'"
        )

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Join bundle adjustment; None elsewhere."""
        if stage.kind != "bundle_adjustment":
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
