r"""Odometry from a TUM trajectory: ``timestamp tx ty tz qx qy qz qw [sigma_rad sigma_m]``.

The poses are those of a body in a world of its own; only the motion from one to the next counts. The sigmas of a row
are those of the rotation and of the translation, per axis of the body, of the motion from the row before it. Over
several rows the twists' covariances add up in the axes of the last one,

    C_ik = Ad(T_jk^{-1}) C_ij Ad(T_jk^{-1})^T + C_jk,

and the camera's motion B^{-1} T B, with B = body_T_cam, has the covariance Ad(B^{-1}) C Ad(B^{-1})^T.
Source: Barfoot and Furgale 2014, "Associating uncertainty with three-dimensional poses", first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.measurements.association import rows_of_frames
from uni4d_fg.frontend.trajectory_files import read_tum_with
from uni4d_fg.geometry import se3


@dataclass(frozen=True)
class Odometry:
    """Motion of the camera between frames."""

    frame: IntArray
    """(M,) ascending."""
    world_T_cam: FloatArray
    """(M, 4, 4) in a world of its own, m."""
    covariance: FloatArray
    """(M, 6, 6) of the twist (rad, m) of the motion from the entry before; zero for the first."""

    def between(self, first: int, last: int) -> tuple[FloatArray, FloatArray]:
        """Return the motion (4, 4) from one entry to a later one, and its covariance (6, 6)."""
        covariance = np.zeros((6, 6))
        for i in range(first + 1, last + 1):
            step = se3.inverse(self.world_T_cam[i - 1]) @ self.world_T_cam[i]
            covariance = se3.composed_covariance(covariance, step, self.covariance[i])
        return se3.inverse(self.world_T_cam[first]) @ self.world_T_cam[last], covariance


def read_odometry(path: Path, timestamps: FloatArray, config: MeasurementsConfig) -> tuple[Odometry, list[str]]:
    """Read the odometry of a sequence.

    Args:
        path: TUM file.
        timestamps: (T,) s of the frames.
        config: Sigmas, tolerance and extrinsics.

    Returns:
        The odometry, and warnings: which frames have none.

    Raises:
        InputError: If the file cannot be read, or fewer than two frames have a pose; the message names the line.
        ConfigError: If ``body_T_cam`` is not a pose.
    """
    body_T_cam = pose_of(config.body_T_cam)
    trajectory, sigmas = read_tum_with(path, ("sigma_rad", "sigma_m"))
    row = rows_of_frames(path, trajectory.timestamps, timestamps, config.tolerance_s)
    frame = np.flatnonzero(row >= 0)
    poses = trajectory.world_T_cam
    covariance = np.zeros((len(frame), 6, 6))
    for m in range(1, len(frame)):
        first, last = int(row[frame[m - 1]]), int(row[frame[m]])
        if sigmas is None:
            sigma = np.repeat([config.odometry_sigma_rad, config.odometry_sigma_m], 3)
            covariance[m] = np.diag(sigma**2) * float(frame[m] - frame[m - 1])
            continue
        for i in range(first + 1, last + 1):
            step = se3.inverse(poses[i - 1]) @ poses[i]
            own = np.diag(np.repeat(sigmas[i], 3) ** 2)
            covariance[m] = se3.composed_covariance(covariance[m], step, own)
    turn = se3.adjoint(se3.inverse(body_T_cam))
    warnings = []
    if len(frame) < len(timestamps):
        warnings.append(
            f"{path.name}: {len(timestamps) - len(frame)} of {len(timestamps)} frames have no odometry within "
            f"{config.tolerance_s:g} s; the motion across them is taken as one step"
        )
    return Odometry(frame, poses[row[frame]] @ body_T_cam, turn @ covariance @ turn.T), warnings


def pose_of(numbers: tuple[float, ...]) -> FloatArray:
    """Return the pose (4, 4) of ``tx ty tz qx qy qz qw``.

    Raises:
        ConfigError: If the quaternion is not of unit length (to 1 %).
    """
    if abs(float(np.linalg.norm(numbers[3:])) - 1.0) > 1e-2:
        raise ConfigError(f"measurements.body_T_cam {list(numbers)}: the last four numbers must be a unit quaternion")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
    pose[:3, 3] = numbers[:3]
    return pose
