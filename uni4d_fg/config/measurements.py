"""Configuration of measurements from files: odometry, GPS, relative poses."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.solver import KernelConfig, NativeKernelConfig

Vector3 = tuple[float, float, float]
Pose7 = tuple[float, float, float, float, float, float, float]


class MeasurementsConfig(Section):
    """How measurements from files are taken; used only where files are given."""

    tolerance_s: float = setting(
        0.02, "A frame takes the measurement nearest in time, if it is at most so many seconds away.", gt=0
    )
    odometry_sigma_rad: float = setting(
        0.005,
        "Standard deviation of the rotation of an odometry step between two successive frames, rad; where the file has "
        "none. Over n frames it is sqrt(n) as much.",
        gt=0,
    )
    odometry_sigma_m: float = setting(0.01, "The same of the translation, m.", gt=0)
    body_T_cam: Pose7 = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "Pose of the camera in the axes of the body that the odometry is of: tx ty tz [m] qx qy qz qw.",
    )
    gps_sigma_m: float = setting(
        1.0, "Standard deviation of a GPS position per axis, m; where the file has none.", gt=0
    )
    gps_lever_arm_m: Vector3 = setting(
        (0.0, 0.0, 0.0), "Position of the GPS antenna in the camera's axes (x right, y down, z forward), m."
    )
    gps_kernel: KernelConfig = setting(
        KernelConfig(kind="huber", threshold=3.0), "Robust kernel of GPS positions: some are far off."
    )
    gps_min_spread: float = setting(
        3.0,
        "GPS joins a solve once the positions are spread over this many of their sigmas (root mean square): before, "
        "they do not say how the map lies.",
        ge=0,
    )
    relative_poses_kernel: NativeKernelConfig = setting(
        NativeKernelConfig(kind="huber", threshold=3.0), "Robust kernel of relative poses: a loop closure may be wrong."
    )
