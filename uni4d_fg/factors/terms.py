"""Every factor type of the package: importing this module declares them all."""

from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.camera_acceleration import camera_angular_acceleration, camera_linear_acceleration
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.camera_priors import fisheye_camera_prior, opencv_camera_prior
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, joint_dynamic_depth_prior, static_depth_prior
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection, joint_dynamic_reprojection
from uni4d_fg.factors.gps_position import gps_position
from uni4d_fg.factors.lens_reprojection import fisheye_reprojection, opencv_reprojection
from uni4d_fg.factors.priors import aspect_prior, intrinsics_prior, log_scale_prior, scale_anchor
from uni4d_fg.factors.rigid_object import rigid_depth_prior, rigid_reprojection, rigid_smoothness
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.zoom import zoom_smoothness, zoomed_reprojection

__all__ = [
    "acceleration_smoothness",
    "arap",
    "aspect_prior",
    "camera_angular_acceleration",
    "camera_linear_acceleration",
    "camera_rotation",
    "camera_translation",
    "depth_reprojection",
    "dynamic_depth_prior",
    "dynamic_reprojection",
    "fisheye_camera_prior",
    "fisheye_reprojection",
    "gps_position",
    "intrinsics_prior",
    "joint_dynamic_depth_prior",
    "joint_dynamic_reprojection",
    "log_scale_prior",
    "opencv_camera_prior",
    "opencv_reprojection",
    "relative_camera_translation",
    "rigid_depth_prior",
    "rigid_reprojection",
    "rigid_smoothness",
    "scale_anchor",
    "static_depth_prior",
    "static_reprojection",
    "velocity_smoothness",
    "zoom_smoothness",
    "zoomed_reprojection",
]
