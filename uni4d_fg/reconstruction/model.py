"""The result of a run, whichever solver made it."""

from __future__ import annotations

from dataclasses import dataclass

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array


@dataclass(frozen=True)
class Reconstruction:
    """Cameras, static landmarks and dynamic trajectories of one video; world = frame 0's camera at the start.

    Dense depth is not held here: it is written per run as ``depth.npy`` and memory-mapped on reading.
    """

    world_T_cam: FloatArray
    """(T, 4, 4) camera to world, OpenCV axes, metres."""
    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px."""
    timestamps: FloatArray
    """(T,) seconds."""
    image_size: tuple[int, int]
    """(height, width), px."""
    depth_log_scale: FloatArray
    """(T,) s_t: the depth cue of frame t is too small by the factor exp(s_t)."""
    landmarks: FloatArray
    """(N, 3) static world points, metres."""
    landmark_track: Int32Array
    """(N,) index of each landmark's track in the labelled tracks."""
    landmark_color: ImageArray
    """(N, 3) RGB."""
    landmark_error: Float32Array
    """(N,) median reprojection error, px."""
    dynamic_points: FloatArray
    """(M, T, 3) world position of each dynamic track per frame, metres; NaN outside its estimated span."""
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
    first camera, see :mod:`uni4d_fg.solve.marginals`; NaN where it is not determined, None in files without it."""
    intrinsics_covariance: FloatArray | None = None
    """(4, 4) px^2, marginal; zero for entries that were held."""

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return int(self.world_T_cam.shape[0])
