"""An accelerometer and a gyroscope on the camera of a synthetic scene.

The camera's poses are joined by a smooth path: a natural quintic spline of positions (C4) and a spline of rotations
with continuous angular acceleration (C2). It passes through every pose, so that the sequence's truth is the path's, and
its derivatives are analytic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.measurements.imu import NOISE_PRESETS, ImuNoise, ImuSamples

MIN_POSES = 6
"""Fewest poses that a path can be laid through."""
WORLD_GRAVITY = np.array([0.0, 9.81, 0.0])
"""Of the synthetic room, whose y axis points down, m/s^2."""


@dataclass(frozen=True)
class Motion:
    """The truth at M times: of the path itself, without sensor errors."""

    world_T_cam: FloatArray
    """(M, 4, 4)."""
    velocity: FloatArray
    """(M, 3) of the camera's center, world axes, m/s."""
    acceleration: FloatArray
    """(M, 3) of the camera's center, world axes, m/s^2."""
    rate: FloatArray
    """(M, 3) camera axes, rad/s."""
    rate_change: FloatArray
    """(M, 3) derivative of the rate, camera axes, rad/s^2."""


class SmoothPath:
    """A smooth path through camera poses."""

    def __init__(self, timestamps: FloatArray, world_T_cam: FloatArray):
        """Join poses (T, 4, 4) at times (T,) s; at least ``MIN_POSES``."""
        straight = [(3, np.zeros(3)), (4, np.zeros(3))]
        self._position: Any = make_interp_spline(timestamps, world_T_cam[:, :3, 3], k=5, bc_type=(straight, straight))
        self._rotation: Any = RotationSpline(timestamps, Rotation.from_matrix(world_T_cam[:, :3, :3]))

    def motion(self, times: FloatArray) -> Motion:
        """Return the truth at times (M,) s."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self._rotation(times).as_matrix()
        poses[:, :3, 3] = self._position(times)
        position, rotation = self._position, self._rotation
        return Motion(poses, position(times, 1), position(times, 2), rotation(times, 1), rotation(times, 2))


@dataclass(frozen=True)
class SimulatedImu:
    """Samples, and the truth behind them."""

    samples: ImuSamples
    path: SmoothPath
    accelerometer_bias: FloatArray
    """(N, 3) m/s^2, body axes."""
    gyroscope_bias: FloatArray
    """(N, 3) rad/s, body axes."""


def simulate_imu(
    timestamps: FloatArray,
    world_T_cam: FloatArray,
    *,
    seed: int = 0,
    rate_hz: float = 200.0,
    noise: ImuNoise | None = NOISE_PRESETS["euroc"],
    body_T_cam: FloatArray | None = None,
    accelerometer_bias: float = 0.05,
    gyroscope_bias: float = 0.005,
    gravity: FloatArray = WORLD_GRAVITY,
) -> SimulatedImu:
    """Measure the path through camera poses.

    Args:
        timestamps: (T,) s of the frames.
        world_T_cam: (T, 4, 4), T at least ``MIN_POSES``.
        seed: Seed of biases and noise.
        rate_hz: Samples per second.
        noise: Of the sensor; None for exact samples with a constant bias.
        body_T_cam: (4, 4) camera on the body; identity if None.
        accelerometer_bias: Standard deviation of each entry of its first bias, m/s^2.
        gyroscope_bias: The same, rad/s.
        gravity: (3,) in the world, m/s^2.
    """
    rng = np.random.default_rng([seed, 5])
    body_T_cam = np.eye(4) if body_T_cam is None else body_T_cam
    steps = int(np.ceil((timestamps[-1] - timestamps[0]) * rate_hz - 1e-9))
    times = timestamps[0] + np.arange(steps + 1) / rate_hz
    path = SmoothPath(timestamps, world_T_cam)
    truth = path.motion(times)
    rotation, lever = body_T_cam[:3, :3], body_T_cam[:3, 3]
    force = np.einsum("nij,ni->nj", truth.world_T_cam[:, :3, :3], truth.acceleration - gravity) @ rotation.T
    rate, change = truth.rate @ rotation.T, truth.rate_change @ rotation.T
    # The body's origin is at -lever from the camera.
    force = force - np.cross(change, lever) - np.cross(rate, np.cross(rate, lever))
    shape = (len(times), 3)
    first = [sigma * rng.standard_normal(3) for sigma in (accelerometer_bias, gyroscope_bias)]
    draws = [rng.standard_normal(shape) for _ in range(4)]
    known = NOISE_PRESETS["euroc"] if noise is None else noise
    amount = np.zeros(4)
    if noise is not None:
        white, walk = np.sqrt(rate_hz), 1.0 / np.sqrt(rate_hz)
        amount[:] = (
            noise.accelerometer * white, noise.gyroscope * white, noise.accelerometer_walk * walk,
            noise.gyroscope_walk * walk,
        )  # fmt: skip
    biases = [first[i] + np.cumsum(amount[2 + i] * draws[2 + i], axis=0) for i in range(2)]
    samples = ImuSamples(
        times, force + biases[0] + amount[0] * draws[0], rate + biases[1] + amount[1] * draws[1], body_T_cam, known
    )
    return SimulatedImu(samples, path, biases[0], biases[1])
