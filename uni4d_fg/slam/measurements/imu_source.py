"""Inertial factors in bundle adjustment: GTSAM's own, with velocities, biases and gravity as variables.

Per pair of successive frames one ``gtsam.CombinedImuFactorWithGravityVector`` on both poses, velocities and biases and
on gravity, whose direction is free and whose magnitude is known. With the first pose held, scale, velocities and
gravity follow from the measurements. Terms of the stage give way: the prior that centers the frames' log-scales at zero
is centered at a value that they have in common and that is free (the cue may be of any scale); the anchor of the scale
and the smoothness of the camera's motion are dropped, because the sensor knows better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.priors import gravity_magnitude, log_scale_about_common, log_scale_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import COMMON_LOG_SCALE, GRAVITY, IMU_BIAS, LOG_SCALE, POSE, VELOCITY
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.optim.added_factors import Addition
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.measurements.imu_alignment import VisualInertialAlignment
from uni4d_fg.slam.measurements.imu_preintegration import preintegrate


@dataclass(frozen=True)
class ImuSource:
    """Adds inertial factors to bundle adjustment; a ``FactorSource``."""

    sums: list[gtsam.PreintegratedCombinedMeasurements]
    """Of the T - 1 intervals between frames."""
    start: VisualInertialAlignment
    config: ImuConfig

    @classmethod
    def of(
        cls, samples: ImuSamples, frame_times: FloatArray, start: VisualInertialAlignment, config: ImuConfig
    ) -> ImuSource:
        """Sum the samples up between frames (T,) s, about the biases of an alignment."""
        moved = samples.at_camera(samples.body_T_cam[:3, :3] @ start.bias[3:])
        return cls(preintegrate(moved, frame_times, start.bias, config), start, config)

    def __call__(self, stage: Stage, state: State) -> Addition | None:
        """Return what joins a stage; None for other stages than those of the static scene."""
        if stage.kind not in ("bundle_adjustment", "structure"):
            return None
        factors: list[Any] = [*self._about_common_scale(stage)]
        variables: dict[VariableType, FloatArray] = {}
        if factors:
            variables[COMMON_LOG_SCALE] = np.mean(state[LOG_SCALE], axis=0, keepdims=True)
        replaced: list[FactorType] = [log_scale_prior]
        if stage.kind == "bundle_adjustment":
            factors += self._inertial_factors()
            variables |= {
                VELOCITY: self.start.velocity,
                IMU_BIAS: np.tile(self.start.bias, (len(self.start.velocity), 1)),
                GRAVITY: self.start.gravity[None],
            }
            replaced += [scale_anchor, camera_rotation, camera_translation]
        return Addition(factors, variables, replaces=replaced)

    def _inertial_factors(self) -> list[Any]:
        config, gravity = self.config, GRAVITY.key(0)
        sigmas = np.repeat([config.accelerometer_bias_sigma, config.gyroscope_bias_sigma], 3)
        factors: list[Any] = [
            gtsam.CombinedImuFactorWithGravityVector(
                POSE.key(t), VELOCITY.key(t), POSE.key(t + 1), VELOCITY.key(t + 1), IMU_BIAS.key(t),
                IMU_BIAS.key(t + 1), gravity, total,
            )
            for t, total in enumerate(self.sums)
        ]  # fmt: skip
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        factors.append(gtsam.PriorFactorConstantBias(IMU_BIAS.key(0), gtsam.imuBias.ConstantBias(), noise))
        factors.append(gravity_magnitude(0, magnitude=np.array([config.gravity]), sigma=config.gravity_sigma))
        return factors

    @staticmethod
    def _about_common_scale(stage: Stage) -> list[FactorBatch]:
        """Return the stage's prior on log-scales with a free center."""
        return [
            log_scale_about_common(batch.slots[0].rows, 0, sigma=batch.sigma, weight=batch.weight, kernel=batch.kernel)
            for batch in stage.problem.batches
            if batch.factor_type is log_scale_prior
        ]
