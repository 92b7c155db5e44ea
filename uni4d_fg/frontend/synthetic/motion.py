"""How vertices move with time: not at all, rigidly along a curve, or bending, twisting and bulging."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.geometry.se3 import so3_exp

Vector = tuple[float, float, float]


class Motion(Protocol):
    """Maps rest-pose vertices (V, 3) to world positions (V, 3) at a time in seconds, meters."""

    def __call__(self, rest: FloatArray, time: float) -> FloatArray:
        """Return the world positions of ``rest`` at ``time``."""
        ...


@dataclass(frozen=True)
class Still:
    """Rest pose and world are the same, always."""

    def __call__(self, rest: FloatArray, time: float) -> FloatArray:
        """Return ``rest`` unchanged."""
        return rest


@dataclass(frozen=True)
class RigidMotion:
    """Translation along a closed curve with a steady rotation."""

    center: Vector
    """Middle of the curve, world, meters."""
    swing: Vector
    """Amplitude along each axis, meters."""
    frequency: Vector
    """Oscillations per second along each axis, Hz."""
    phase: Vector
    """Phase of each axis at time 0, rad."""
    tilt: Vector = (0.0, 0.0, 0.0)
    """Rotation vector at time 0, rad."""
    rotation_rate: Vector = (0.0, 0.0, 0.0)
    """World-frame angular velocity, rad/s; its direction is constant."""

    def pose(self, time: float) -> FloatArray:
        """Return (4, 4) world_T_object at ``time`` seconds: the object's frame is the one of its rest pose, meters."""
        angle = 2.0 * np.pi * np.asarray(self.frequency) * time + np.asarray(self.phase)
        world_T_object = np.eye(4)
        world_T_object[:3, 3] = np.asarray(self.center) + np.asarray(self.swing) * np.sin(angle)
        world_T_object[:3, :3] = so3_exp(np.asarray(self.rotation_rate) * time) @ so3_exp(
            np.asarray(self.tilt, dtype=np.float64)
        )
        return world_T_object

    def __call__(self, rest: FloatArray, time: float) -> FloatArray:
        """Return ``rest`` rotated about its origin and moved to its place on the curve."""
        world_T_object = self.pose(time)
        result: FloatArray = rest @ world_T_object[:3, :3].T + world_T_object[:3, 3]
        return result


@dataclass(frozen=True)
class WobblyMotion:
    """A body along y that bends, twists and bulges while a rigid motion carries it."""

    carrier: RigidMotion
    """Motion of the body as a whole."""
    height_m: float
    """Height of the rest body, meters."""
    bend_m: float = 0.14
    """Sideways excursion of the ends by bending, meters."""
    wave_m: float = 0.04
    """Amplitude of the wave that runs along the body, meters."""
    twist_rad: float = 0.6
    """Twist between the two ends, rad."""
    bulge: float = 0.16
    """Relative change of the radius."""
    frequency_hz: float = 0.5
    """Oscillations per second; the parts use different multiples of it."""
    phase: float = 0.0
    """Phase at time 0, rad."""

    def __call__(self, rest: FloatArray, time: float) -> FloatArray:
        """Return the deformed body in the world."""
        along = rest[:, 1] / self.height_m
        beat = 2.0 * np.pi * self.frequency_hz * time + self.phase
        angle = self.twist_rad * along * np.sin(0.8 * beat)
        radial = 1.0 + self.bulge * np.sin(2.0 * np.pi * along - 1.3 * beat)
        cosine, sine = np.cos(angle), np.sin(angle)
        bent = np.empty_like(rest)
        bent[:, 0] = radial * (cosine * rest[:, 0] + sine * rest[:, 2])
        bent[:, 2] = radial * (cosine * rest[:, 2] - sine * rest[:, 0])
        bent[:, 1] = rest[:, 1] * (1.0 + 0.06 * np.sin(1.1 * beat))
        bent[:, 0] += self.bend_m * (4.0 * along**2 - 0.5) * np.sin(beat)
        bent[:, 2] += self.wave_m * np.sin(1.5 * np.pi * along + beat)
        return self.carrier(bent, time)
