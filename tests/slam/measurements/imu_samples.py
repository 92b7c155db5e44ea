"""A camera path with an IMU on it, as a visual reconstruction sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.frontend.measurements.imu import NOISE_PRESETS, ImuNoise
from uni4d_fg.frontend.synthetic.camera_path import camera_path
from uni4d_fg.frontend.synthetic.imu import WORLD_GRAVITY, Motion, SimulatedImu, simulate_imu
from uni4d_fg.geometry import se3

BODY_T_CAM = se3.se3_exp(np.array([0.3, -0.2, 1.0, 0.1, 0.05, -0.2]))


@dataclass(frozen=True)
class Ride:
    """The truth, in the world of the first camera."""

    times: FloatArray
    world_T_cam: FloatArray
    velocity: FloatArray
    gravity: FloatArray
    imu: SimulatedImu
    bias: FloatArray
    """(T, 6) at the frames, camera axes."""


def ride(
    count: int = 40, seed: int = 0, noise: ImuNoise | None = NOISE_PRESETS["euroc"], rate_hz: float = 200.0
) -> Ride:
    times = np.arange(count) / 15.0
    poses = camera_path("handheld", times, 0.84)
    imu = simulate_imu(times, poses, seed=seed, noise=noise, body_T_cam=BODY_T_CAM, rate_hz=rate_hz)
    motion: Motion = imu.path.motion(times)
    to_first = se3.inverse(poses[0])
    rows = np.minimum(np.searchsorted(imu.samples.timestamps, times - 1e-9), len(imu.samples) - 1)
    rotation = BODY_T_CAM[:3, :3]
    bias = np.concatenate([imu.accelerometer_bias[rows] @ rotation, imu.gyroscope_bias[rows] @ rotation], axis=1)
    return Ride(
        times, to_first @ poses, motion.velocity @ to_first[:3, :3].T, to_first[:3, :3] @ WORLD_GRAVITY, imu, bias
    )


def seen_by_cameras(
    truth: Ride, scale: float, sigma_m: float, sigma_rad: float, dark: slice | None = None, seed: int = 0
) -> tuple[FloatArray, IntArray]:
    """Noisy poses in units of ``scale`` meters; with a blackout, what follows stands somewhere else."""
    rng = np.random.default_rng(seed)
    count = len(truth.times)
    poses = truth.world_T_cam.copy()
    part = np.zeros(count, dtype=np.int64)
    if dark is not None:
        moved = se3.se3_exp(np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.3]))
        poses[dark.stop :] = moved @ poses[dark.stop :]
        poses[dark] = poses[dark.start - 1]
        part[dark], part[dark.stop :] = -1, 1
    poses[1:, :3, :3] = poses[1:, :3, :3] @ se3.so3_exp(sigma_rad * rng.normal(size=(count - 1, 3)))
    poses[1:, :3, 3] += sigma_m * rng.normal(size=(count - 1, 3))
    poses[:, :3, 3] /= scale
    return poses, part
