r"""Where an antenna on the camera is on a map.

    r = R_m (R_t l + c_t) + t_m - z        [m], 3-vector

(R_m, t_m) is ``map_T_world``, (R_t, c_t) the camera's pose ``world_T_cam``, l the antenna's position ``lever_arm`` in
the camera's axes and z its position ``xyz`` on the map. With p = R_t l + c_t the point in the world, and tangents in
the frame of each transform,

    dr/dxi_m = R_m [-skew(p), I],        dr/dxi_t = R_m R_t [-skew(l), I]

Source: the chain rule; GTSAM's ``GPSFactorArm`` is the same with the map held at the world.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import GPS_MAP, POSE
from uni4d_fg.geometry.camera import camera_to_world
from uni4d_fg.geometry.se3 import skew


@factor(GPS_MAP, POSE, data={"xyz": 3, "lever_arm": 3}, dim=3)
def gps_position(map_T_world: Array, world_T_cam: Array, *, xyz: Array, lever_arm: Array) -> Array:
    """Return (N, 3) m of map poses (N, 4, 4), camera poses (N, 4, 4), positions (N, 3) and lever arms (N, 3)."""
    return camera_to_world(map_T_world, camera_to_world(world_T_cam, lever_arm)) - xyz


@gps_position.jacobian
def gps_position_jacobian(
    map_T_world: FloatArray, world_T_cam: FloatArray, *, xyz: FloatArray, lever_arm: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians, each (N, 3, 6)."""
    point = camera_to_world(world_T_cam, lever_arm)
    on_map = map_T_world[:, :3, :3]
    by_camera = on_map @ world_T_cam[:, :3, :3]
    jacobians = [
        np.concatenate([-on_map @ skew(point), on_map], axis=2),
        np.concatenate([-by_camera @ skew(lever_arm), by_camera], axis=2),
    ]
    return camera_to_world(map_T_world, point) - xyz, jacobians
