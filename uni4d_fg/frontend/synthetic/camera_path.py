"""Camera trajectories through the synthetic room."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.synthetic import PathKind
from uni4d_fg.geometry.se3 import so3_exp

_START = np.array([-0.1, -0.15, -1.75])
_TARGET = np.array([0.05, 0.28, 0.6])
_FORWARD_AMPLITUDE_M = 0.6


def look_at(position: FloatArray, target: FloatArray, roll: FloatArray) -> FloatArray:
    """Point cameras at targets, with the world's y axis (down) close to the image's.

    Args:
        position: (T, 3) camera centers, meters.
        target: (T, 3) points on the optical axes, meters.
        roll: (T,) rotation about the optical axis, rad.

    Returns:
        (T, 4, 4) camera to world, OpenCV axes.
    """
    forward = target - position
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack((right, np.cross(forward, right), forward), axis=-1)
    axis_turn = np.zeros_like(position)
    axis_turn[:, 2] = roll
    world_T_cam = np.tile(np.eye(4), (len(position), 1, 1))
    world_T_cam[:, :3, :3] = rotation @ so3_exp(axis_turn)
    world_T_cam[:, :3, 3] = position
    return world_T_cam


def _curve(parameter: FloatArray) -> FloatArray:
    """Return (N, 3) positions on a closed curve about 1 m wide in front of the objects, meters."""
    x = 0.42 * np.sin(parameter - 0.9)
    y = 0.12 * np.sin(2.0 * parameter + 0.4)
    z = 0.2 * np.cos(1.0 * parameter + 0.3)
    return _START + np.stack((x, y, z), axis=-1)


def _positions_at(distance: FloatArray) -> FloatArray:
    """Return (T, 3) positions after traveling ``distance`` meters along the closed curve."""
    parameter = np.linspace(0.0, 2.0 * np.pi, 8001)
    step = np.linalg.norm(np.diff(_curve(parameter), axis=0), axis=-1)
    traveled = np.concatenate(([0.0], np.cumsum(step)))
    return _curve(np.interp(distance % traveled[-1], traveled, parameter))


def _tremor(time: FloatArray, amplitude: float, phase: float) -> FloatArray:
    """Return (T, 3) smooth small offsets such as a hand makes, in the unit of ``amplitude``."""
    phases = phase + np.array([0.0, 2.1, 4.4])
    slow = np.sin(2.0 * np.pi * 0.9 * time[:, None] + phases)
    fast = np.sin(2.0 * np.pi * 2.3 * time[:, None] + 1.7 * phases)
    result: FloatArray = amplitude * (0.7 * slow + 0.3 * fast)
    return result


def camera_path(kind: PathKind, timestamps: FloatArray, speed: float) -> FloatArray:
    """Sample a camera trajectory.

    Args:
        kind: ``"handheld"`` travels on a closed curve, looking at the room's middle, with a slight tremor;
            ``"static"`` rests; ``"rotation"`` turns about a fixed center; ``"forward"`` moves along its fixed
            optical axis (and after a while back).
        timestamps: (T,) seconds.
        speed: Meters per second along the path; ``"rotation"`` turns at ``speed`` times 0.4 rad/m at most.

    Returns:
        (T, 4, 4) camera to world, OpenCV axes, meters. Frame 0 is not the identity.
    """
    num_frames = len(timestamps)
    still = np.zeros(num_frames)
    start, target = np.tile(_START, (num_frames, 1)), np.tile(_TARGET, (num_frames, 1))
    distance = speed * timestamps
    if kind == "static":
        return look_at(start, target, still)
    if kind == "rotation":
        angle = 0.25 * np.sin(0.4 / 0.25 * distance)
        target[:, 0] += 2.0 * np.tan(angle)
        target[:, 1] += 0.3 * np.sin(1.1 * distance)
        return look_at(start, target, 0.3 * angle)
    if kind == "forward":
        axis = (_TARGET - _START) / np.linalg.norm(_TARGET - _START)
        travel = _FORWARD_AMPLITUDE_M * np.sin(distance / _FORWARD_AMPLITUDE_M)
        return look_at(start + travel[:, None] * axis, target + travel[:, None] * axis, still)
    position = _positions_at(distance) + _tremor(timestamps, 0.003, 0.3)
    target = target + _tremor(timestamps, 0.008, 1.9) + 0.12 * np.sin(0.9 * timestamps[:, None] + [0.0, 1.0, 2.0])
    roll = 0.03 * np.sin(1.3 * timestamps) + 0.003 * np.sin(11.0 * timestamps)
    return look_at(position, target, roll)
