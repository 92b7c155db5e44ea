"""Where the camera is: paths through the world, and the unrest of a hand or a car."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.surface import Vector
from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.synthetic.camera_path import look_at
from uni4d_fg.geometry.se3 import so3_exp

Camera = Callable[[float], FloatArray]
"""Maps a time in seconds to world_T_cam (4, 4): x right, y down, z forward, meters."""


def looking(position: FloatArray | Vector, target: FloatArray | Vector) -> FloatArray:
    """Return world_T_cam (4, 4) of an upright camera at a position that looks at a target, meters."""
    eye, point = (np.asarray(place, dtype=np.float64)[None] for place in (position, target))
    pose: FloatArray = look_at(eye, point, np.zeros(1))[0]
    return pose


def wander(
    seed: int, low_hz: float, high_hz: float, dimensions: int = 3, waves: int = 6
) -> Callable[[float], FloatArray]:
    """Return a smooth random function of time in seconds with values (dimensions,) of unit deviation.

    Args:
        seed: Seed.
        low_hz: Lowest frequency.
        high_hz: Highest frequency.
        dimensions: Length of the value.
        waves: How many sinusoids are summed in each dimension.
    """
    rng = np.random.default_rng(seed)
    frequency = 2 * np.pi * np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), (dimensions, waves)))
    phase = rng.uniform(0, 2 * np.pi, (dimensions, waves))

    def value(time: float) -> FloatArray:
        result: FloatArray = np.sin(frequency * time + phase).sum(axis=1) * np.sqrt(2.0 / waves)
        return result

    return value


@dataclass(frozen=True)
class Unrest:
    """How a camera departs from its path."""

    seed: int
    sway_m: float = 0.012
    """Deviation of slow drifts of the position."""
    sway_deg: float = 0.5
    """Deviation of slow turns."""
    tremor_deg: float = 0.04
    """Deviation of fast turns (4 to 9 Hz)."""
    step_hz: float = 0.0
    """Steps per second of somebody who walks with the camera, 0 for none."""
    step_m: float = 0.018
    """Amplitude of the steps up and down."""

    def on(self, path: Camera) -> Camera:
        """Return the path with the unrest on it."""
        drift, turn = wander(self.seed, 0.25, 0.9), wander(self.seed + 1, 0.2, 1.0)
        tremor = wander(self.seed + 2, 4.0, 9.0)

        def camera(time: float) -> FloatArray:
            pose = path(time).copy()
            phase = np.pi * self.step_hz * time
            steps = self.step_m * np.array([0.6 * np.sin(phase), np.cos(2 * phase), 0.0]) * (self.step_hz > 0)
            angle = np.deg2rad(self.sway_deg * turn(time) * (1.0, 1.0, 0.7) + self.tremor_deg * tremor(time))
            if self.step_hz > 0:
                angle = angle + np.deg2rad([0.25 * np.cos(2 * phase + 0.6), 0.2 * np.sin(phase), 0.3 * np.sin(phase)])
            pose[:3, 3] += pose[:3, :3] @ (self.sway_m * drift(time) + steps)
            pose[:3, :3] = pose[:3, :3] @ so3_exp(angle)
            return pose

        return camera


def smooth(share: float | FloatArray) -> FloatArray:
    """Return 0 below 0, 1 above 1 and a smooth step between."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))
