"""Configuration of inertial measurements."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting


class ImuConfig(Section):
    """Accelerometer and gyroscope in bundle adjustment; the noise of the sensor comes with its samples."""

    gravity: float = setting(9.81, "Acceleration of gravity at the place, m/s^2 (9.78 to 9.83).", gt=0, basic=True)
    gravity_sigma: float = setting(0.01, "Standard deviation of that, m/s^2.", gt=0)
    accelerometer_bias_sigma: float = setting(
        0.1, "Standard deviation of each entry of the first accelerometer bias about zero, m/s^2.", gt=0
    )
    gyroscope_bias_sigma: float = setting(
        0.01, "Standard deviation of each entry of the first gyroscope bias about zero, rad/s.", gt=0
    )
    integration_sigma: float = setting(
        1e-4, "What integration in steps of the samples adds to the noise of positions, m/sqrt(s).", gt=0
    )
    min_shared_tracks: int = setting(
        8, "Frames that share fewer static tracks do not hold together: inertial measurements alone join them.", ge=3
    )
    camera_position_sigma_m: float = setting(
        5e-3, "Alignment: starting standard deviation of the camera positions that bundle adjustment found, m.", gt=0
    )
    max_scale_sigma: float = setting(
        0.1,
        "Alignment: the relative standard deviation of the scale above which the camera's motion does not determine "
        "it, and the run ends.",
        gt=0,
    )
