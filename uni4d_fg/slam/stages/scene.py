"""What stages hand to each other: the cameras, the static scene, the moving points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.stages.acceleration import AccelerationPrior
from uni4d_fg.slam.stages.observations import Observations


@dataclass(frozen=True)
class Cameras:
    """Poses, shared intrinsics and depth scales of consecutive frames."""

    world_T_cam: FloatArray
    """(T, 4, 4)."""
    intrinsics: FloatArray
    """(4,) px."""
    log_scale: FloatArray
    """(T,) the depth cue of frame t times ``exp`` of this agrees with the poses."""

    def part(self, start: int, stop: int) -> Cameras:
        """Return those of frames ``start`` to ``stop - 1``, in the axes of the first of them."""
        poses = se3.inverse(self.world_T_cam[start])[None] @ self.world_T_cam[start:stop]
        poses[0] = np.eye(4)
        return Cameras(poses, self.intrinsics.copy(), self.log_scale[start:stop].copy())

    def state(self, landmarks: FloatArray, track: IntArray | None = None, frame: IntArray | None = None) -> State:
        """Return the variables of a static scene with landmarks (N, 3) of the given tracks (N,).

        Args:
            landmarks: (N, 3).
            track: (N,) their numbers; row numbers when None.
            frame: (T,) numbers of the frames; row numbers when None.
        """
        arrays = {
            POSE: self.world_T_cam,
            INTRINSICS: self.intrinsics.reshape(1, 4),
            LOG_SCALE: self.log_scale.reshape(-1, 1),
            LANDMARK: landmarks,
        }
        index = {} if track is None else {LANDMARK: track}
        return State(arrays, index if frame is None else {**index, POSE: frame, LOG_SCALE: frame})

    @classmethod
    def of(cls, state: State) -> Cameras:
        """Return the cameras of a state."""
        return cls(state[POSE], state[INTRINSICS][0], state[LOG_SCALE][:, 0])


@dataclass(frozen=True)
class StaticNoise:
    """Noise of the static scene: what moving points are then judged by."""

    reprojection_sigma_px: float
    depth_sigma: float
    depth_correlation: float = 0.0
    """How alike the log-depth errors of one track are, in [0, 1]."""
    overstated: float = 1.0
    """The reprojection sigma as a multiple of what was measured: above one where that lies below the floor."""

    @property
    def measured_px(self) -> float:
        """Reprojection sigma that was measured, px, whatever the floor."""
        return self.reprojection_sigma_px / self.overstated

    def array(self) -> FloatArray:
        """Return it as records hold it, (3,): sigma of reprojection, px, sigma and correlation of the depth cue."""
        return np.array([self.reprojection_sigma_px, self.depth_sigma, self.depth_correlation])

    @classmethod
    def of_array(cls, noise: FloatArray) -> StaticNoise:
        """Return what :meth:`array` was made of; records of before had no correlation (2,)."""
        return cls(*noise.tolist())

    def effective_depth_sigma(self, observations_per_track: float) -> float:
        """Return the sigma at which n equally correlated depths of a track carry the information they have.

        n values with correlation c carry as much as ``n / (1 + (n - 1) c)`` independent ones.
        """
        return self.depth_sigma * float(np.sqrt(1.0 + max(observations_per_track - 1.0, 0.0) * self.depth_correlation))


@dataclass(frozen=True)
class StaticScene:
    """The static scene at the end of bundle adjustment."""

    cameras: Cameras
    landmarks: FloatArray
    """(N, 3)."""
    landmark_track: IntArray
    """(N,)."""
    observations: Observations
    """Observations of the kept landmarks."""
    noise: StaticNoise
    landmark_error: Float32Array
    """(N,) median reprojection error, px."""
    pose_covariance: FloatArray
    """(T, 6, 6) marginal covariance of each pose's body-frame twist (rad, m), relative to frame 0; NaN if unknown."""
    intrinsics_covariance: FloatArray
    """(4, 4) px^2; zero for entries that are held, NaN if unknown."""
    solves: list[SolveSummary] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    """Number of observations or landmarks dropped, per reason."""
    joined: int = 0
    """Number of tracks that were solved as part of another one's landmark; they have its position."""
    acceleration: AccelerationPrior | None = None
    """The prior on the cameras' acceleration that they were solved with; None without one."""
    focal_depth_error: float = 0.0
    """Mean relative error of depth, scale apart, that a standard deviation of focal lengths that were held makes."""

    def state(self) -> State:
        """Return the variables of the scene."""
        return self.cameras.state(self.landmarks, self.landmark_track)


@dataclass(frozen=True)
class DynamicScene:
    """The trajectories of what moves, at the end of non-rigid bundle adjustment."""

    points: FloatArray
    """(M, T, 3) world, m; NaN outside each trajectory's span."""
    observed: BoolArray
    """(M, T)."""
    track: IntArray
    """(M,)."""
    instance: IntArray
    """(M,)."""
    solve: SolveSummary | None = None
    dropped: dict[str, int] = field(default_factory=dict)


def unknown_covariances(num_frames: int) -> tuple[FloatArray, FloatArray]:
    """Return pose (T, 6, 6) and intrinsics (4, 4) covariances that say nothing: NaN."""
    return np.full((num_frames, 6, 6), np.nan), np.full((4, 4), np.nan)
