"""Inertial factors in bundle adjustment: GTSAM's own, with velocities, biases and gravity as variables.

Per pair of successive frames one ``gtsam.CombinedImuFactorWithGravityVector`` on both poses, velocities and biases and
on gravity, whose direction is free and whose magnitude is known. With the first pose held, scale, velocities and
gravity follow from the measurements. The depth cue may be of any scale (:mod:`uni4d_fg.optim.metric_scale`). The anchor
of the scale and the smoothness of the camera's motion are dropped, because the sensor knows better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.factors.camera_acceleration import camera_angular_acceleration, camera_linear_acceleration
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.priors import gravity_magnitude, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import GRAVITY, IMU_BIAS, POSE, VELOCITY
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
        if stage.kind == "structure":  # has frozen cameras: all that there is to say is that they are metric
            return Addition([])
        variables = {
            VELOCITY: self.start.velocity,
            IMU_BIAS: np.tile(self.start.bias, (len(self.start.velocity), 1)),
            GRAVITY: self.start.gravity[None],
        }
        replaced = [
            scale_anchor, camera_rotation, camera_translation, relative_camera_translation, camera_angular_acceleration,
            camera_linear_acceleration,
        ]  # fmt: skip
        return Addition(self._inertial_factors(), variables, replaces=replaced)

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
