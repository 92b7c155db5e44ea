"""The variables of the reconstruction.

| variable | key | value | tangent |
|---|---|---|---|
| ``POSE`` | x(frame) | (4, 4) ``world_T_cam`` | 6: body-frame (omega [rad], v [m]), ``T Exp(xi)`` |
| ``INTRINSICS`` | k(camera) | (4,) fx, fy, cx, cy, px | 4 |
| ``OPENCV_CAMERA`` | d(camera) | (8,) fx, fy, cx, cy, px, and k1, k2, p1, p2 | 8 |
| ``FISHEYE_CAMERA`` | f(camera) | (8,) fx, fy, cx, cy, px, and k1, k2, k3, k4 | 8 |
| ``LOG_SCALE`` | s(frame) | (1,) log-scale of a frame's depth cue | 1 |
| ``LANDMARK`` | l(track) | (3,) world, m | 3 |
| ``DYNAMIC_POINT`` | p(track, frame) | (3,) world, m | 3 |
| ``OBJECT_POSE`` | o(instance, frame) | (4, 4) ``world_T_object`` | 6: body-frame (omega [rad], v [m]) |
| ``OBJECT_POINT`` | q(track) | (3,) in the object's frame, m | 3 |
| ``VELOCITY`` | v(frame) | (3,) of the camera, world axes, m/s | 3 |
| ``IMU_BIAS`` | b(frame) | (6,) accelerometer [m/s^2], gyroscope [rad/s], camera axes | 6 |
| ``GRAVITY`` | g(0) | (3,) acceleration of gravity, world axes, m/s^2 | 3 |
| ``GPS_MAP`` | e(map) | (4, 4) ``map_T_world`` | 6: body-frame (omega [rad], v [m]) |
| ``ZOOM`` | z(frame) | (1,) logarithm of a frame's focal length over that of the intrinsics | 1 |
| ``CUE_SCALE`` | c(cue) | (1,) log-scale that the depth cues of all frames share | 1 |
"""

from __future__ import annotations

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.variable import SE3, VariableType, vector_space

CALIBRATION_COLUMNS = (0, 1, 3, 4)
"""Where fx, fy, cx, cy stand in the vector of a ``gtsam.Cal3_S2``; entry 2 is the skew."""
LENS_COLUMNS = (*CALIBRATION_COLUMNS, 5, 6, 7, 8)
"""The same in the vector of a ``gtsam.Cal3DS2`` or ``gtsam.Cal3Fisheye``, distortion parameters last."""


def calibration(intrinsics: FloatArray) -> gtsam.Cal3_S2:
    """Return intrinsics (4,) as GTSAM's pinhole without skew."""
    fx, fy, cx, cy = intrinsics.tolist()
    return gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)


def _at_pose(values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(values.atPose3(key).matrix(), dtype=np.float64)


def _at_calibration(values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(values.atCal3_S2(key).vector(), dtype=np.float64)[list(CALIBRATION_COLUMNS)]


def _opencv_camera(camera: FloatArray) -> gtsam.Cal3DS2:
    fx, fy, cx, cy, *lens = camera.tolist()
    return gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *lens)


def _at_opencv_camera(values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(values.atCal3DS2(key).vector(), dtype=np.float64)[list(LENS_COLUMNS)]


def _fisheye_camera(camera: FloatArray) -> gtsam.Cal3Fisheye:
    fx, fy, cx, cy, *lens = camera.tolist()
    return gtsam.Cal3Fisheye(fx, fy, 0.0, cx, cy, *lens)


def _at_fisheye_camera(values: gtsam.Values, key: int) -> FloatArray:
    camera = values.atCal3Fisheye(key)
    return np.array(
        [camera.fx(), camera.fy(), camera.px(), camera.py(), camera.k1(), camera.k2(), camera.k3(), camera.k4()]
    )


def _at_point(values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(values.atPoint3(key), dtype=np.float64)


def _at_bias(values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(values.atConstantBias(key).vector(), dtype=np.float64)


def pose_variable(name: str, symbol: str, index: tuple[str, ...] = ("frame",), label: str = "") -> VariableType:
    """Declare a variable that is a rigid transform, a ``gtsam.Pose3``."""
    return VariableType(name, symbol, SE3, index, label, to_gtsam=gtsam.Pose3, from_gtsam=_at_pose)


def point_variable(name: str, symbol: str, index: tuple[str, ...] = ("track",), label: str = "") -> VariableType:
    """Declare a variable that is a 3-vector, a ``gtsam.Point3``."""
    return VariableType(name, symbol, vector_space(3), index, label, from_gtsam=_at_point)


POSE = pose_variable("pose", "x", label="camera pose")
INTRINSICS = VariableType(
    "intrinsics", "k", vector_space(4), ("camera",),
    to_gtsam=calibration, from_gtsam=_at_calibration, gtsam_columns=CALIBRATION_COLUMNS, gtsam_dim=5,
)  # fmt: skip
OPENCV_CAMERA = VariableType(
    "opencv_camera", "d", vector_space(8), ("camera",), "camera with a lens",
    to_gtsam=_opencv_camera, from_gtsam=_at_opencv_camera, gtsam_columns=LENS_COLUMNS, gtsam_dim=9,
)  # fmt: skip
FISHEYE_CAMERA = VariableType(
    "fisheye_camera", "f", vector_space(8), ("camera",), "fisheye camera",
    to_gtsam=_fisheye_camera, from_gtsam=_at_fisheye_camera, gtsam_columns=LENS_COLUMNS, gtsam_dim=9,
)  # fmt: skip
LOG_SCALE = VariableType("log_scale", "s", vector_space(1), label="depth log-scale")
LANDMARK = point_variable("landmark", "l")
DYNAMIC_POINT = point_variable("dynamic_point", "p", ("track", "frame"))
OBJECT_POSE = pose_variable("object_pose", "o", ("instance", "frame"))
OBJECT_POINT = point_variable("object_point", "q")
VELOCITY = point_variable("velocity", "v", ("frame",))
IMU_BIAS = VariableType(
    "imu_bias", "b", vector_space(6), label="IMU bias",
    to_gtsam=lambda value: gtsam.imuBias.ConstantBias(value[:3], value[3:]), from_gtsam=_at_bias,
)  # fmt: skip
GRAVITY = point_variable("gravity", "g", ("",))
GPS_MAP = pose_variable("gps_map", "e", ("map",), label="pose of the world on the GPS map")
CUE_SCALE = VariableType("cue_scale", "c", vector_space(1), ("cue",), label="log-scale of the depth cue")
ZOOM = VariableType("zoom", "z", vector_space(1), label="log-focal length")
