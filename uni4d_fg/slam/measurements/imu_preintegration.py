"""Inertial measurements between frames, summed up by GTSAM's preintegration.

Samples are those of an IMU at the camera (:meth:`~uni4d_fg.frontend.measurements.imu.ImuSamples.at_camera`), so that
GTSAM's body is the camera. Gravity is left to the factor, which has it as a variable.

GTSAM holds a sample for a whole step, with the rotation of its beginning. Between two samples this would turn gravity
by half a step too little, ``|w| dt g / 2``, which does not average out. Each step is therefore given the mean of the
samples at its ends, turned by half of the step's rotation: the midpoint rule, exact to second order.
Sources: Forster et al. 2017, "On-manifold preintegration"; Carlone et al. 2015 (GTSAM's CombinedImuFactor).
"""

from __future__ import annotations

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.frontend.measurements.imu import ImuNoise, ImuSamples
from uni4d_fg.geometry.se3 import so3_exp


def preintegration_parameters(noise: ImuNoise, config: ImuConfig) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for a sensor, without gravity."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(0.0)
    params.setAccelerometerCovariance(np.eye(3) * noise.accelerometer**2)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyroscope**2)
    params.setIntegrationCovariance(np.eye(3) * config.integration_sigma**2)
    params.setBiasAccCovariance(np.eye(3) * noise.accelerometer_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyroscope_walk**2)
    return params


def preintegrate(
    samples: ImuSamples, frame_times: FloatArray, bias: FloatArray, config: ImuConfig
) -> list[gtsam.PreintegratedCombinedMeasurements]:
    """Sum up the samples between successive frames.

    Args:
        samples: Of an IMU at the camera.
        frame_times: (T,) s.
        bias: (6,) accelerometer, gyroscope: the biases that the sums are linearized at.
        config: Noise of the integration.

    Returns:
        T - 1 sums.
    """
    params = preintegration_parameters(samples.noise, config)
    start = gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
    return [
        _sum(samples, first, last, bias, gtsam.PreintegratedCombinedMeasurements(params, start))
        for first, last in zip(frame_times[:-1].tolist(), frame_times[1:].tolist(), strict=True)
    ]


def _sum(
    samples: ImuSamples, first: float, last: float, bias: FloatArray, total: gtsam.PreintegratedCombinedMeasurements
) -> gtsam.PreintegratedCombinedMeasurements:
    inside = samples.timestamps[(samples.timestamps > first) & (samples.timestamps < last)]
    times = np.concatenate([[first], inside, [last]])
    accelerometer, gyroscope = (0.5 * (ends[1:] + ends[:-1]) for ends in samples.at(times))
    step = np.diff(times)
    half = so3_exp(0.5 * step[:, None] * (gyroscope - bias[3:]))
    turned = bias[:3] + np.einsum("nij,nj->ni", half, accelerometer - bias[:3])
    for a, w, dt in zip(turned, gyroscope, step.tolist(), strict=True):
        if dt > 0.0:
            total.integrateMeasurement(a, w, dt)
    return total
