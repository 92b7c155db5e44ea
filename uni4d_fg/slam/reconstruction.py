"""The result of a run, whichever solver made it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.geometry.lens import PINHOLE, Lens

OBJECT_ARRAYS = (
    "object_instance",
    "object_reference",
    "object_observed",
    "object_world_T_object",
    "object_covariance",
    "object_velocity",
)
"""Fields of rigid objects: all of them or none."""


@dataclass(frozen=True)
class Reconstruction:
    """Cameras, static landmarks and dynamic trajectories of one video; world = frame 0's camera at the start.

    Dense depth is not held here: it is written per run as ``depth.npy`` and memory-mapped on reading.
    """

    world_T_cam: FloatArray
    """(T, 4, 4) camera to world, OpenCV axes, meters."""
    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px."""
    timestamps: FloatArray
    """(T,) seconds."""
    image_size: tuple[int, int]
    """(height, width), px."""
    depth_log_scale: FloatArray
    """(T,) s_t: the depth cue of frame t is too small by the factor exp(s_t)."""
    landmarks: FloatArray
    """(N, 3) static world points, meters."""
    landmark_track: Int32Array
    """(N,) index of each landmark's track in the labelled tracks."""
    landmark_color: ImageArray
    """(N, 3) RGB."""
    landmark_error: Float32Array
    """(N,) median reprojection error, px."""
    dynamic_points: FloatArray
    """(M, T, 3) world position of each dynamic track per frame, meters; NaN outside its estimated span."""
    dynamic_observed: BoolArray
    """(M, T) True where the point was seen, False where it is bridged by the motion prior."""
    dynamic_track: Int32Array
    """(M,) index of each trajectory's track in the labelled tracks."""
    dynamic_instance: Int32Array
    """(M,) mask id."""
    dynamic_color: ImageArray
    """(M, 3) RGB."""
    pose_covariance: FloatArray | None = None
    """(T, 6, 6) marginal covariance of each pose's body-frame twist (rotation rad, translation m) relative to the
    first camera, see :mod:`uni4d_fg.optim.marginals`; NaN where it is not determined, None in files without it."""
    intrinsics_covariance: FloatArray | None = None
    """(4, 4) px^2, marginal; zero for entries that were held."""
    lens: Lens = PINHOLE
    """Distortion; the images are of this camera, the intrinsics those of its pinhole."""
    zoom: FloatArray | None = None
    """(T,) focal length of each frame over that of ``intrinsics``; None for a camera that does not zoom."""
    object_instance: Int32Array | None = None
    """(J,) mask ids of the moving instances that are rigid bodies; None, as all that follow, where none was sought."""
    object_reference: Int32Array | None = None
    """(J,) frame in which the object's origin is the middle of its points, and its axes are the world's."""
    object_observed: BoolArray | None = None
    """(J, T) frames that see enough of the object; poses in between hang on the smoothness of its motion alone."""
    object_world_T_object: FloatArray | None = None
    """(J, T, 4, 4) object to world, meters; NaN before the first and after the last frame that sees the object."""
    object_covariance: FloatArray | None = None
    """(J, T, 6, 6) of the pose's body-frame twist (rotation rad, translation m), relative to the reference frame and
    with the cameras taken for exact; NaN where there is no pose or it is not determined."""
    object_velocity: FloatArray | None = None
    """(J, T, 6) body-frame twist (rad/s, m/s); NaN where there is no pose."""

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return int(self.world_T_cam.shape[0])

    @property
    def frame_intrinsics(self) -> FloatArray:
        """(T, 4) fx, fy, cx, cy of each frame, px."""
        return zoomed(self.intrinsics, self.zoom, self.num_frames)


def zoomed(intrinsics: FloatArray, zoom: FloatArray | None, num_frames: int) -> FloatArray:
    """Return the intrinsics (T, 4) of frames whose focal lengths are ``zoom`` (T,) times that of (4,) ones, px."""
    factor = np.ones((num_frames, 4))
    if zoom is not None:
        factor[:, :2] = zoom[:, None]
    return intrinsics * factor
