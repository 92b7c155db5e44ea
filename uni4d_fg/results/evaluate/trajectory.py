"""Camera trajectory errors: absolute (ATE) and relative (RPE), by the protocol common in the field."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import Degeneracy, Similarity, align_trajectories

AlignmentMode: TypeAlias = Literal["sim3", "se3", "none"]

_ALIGNMENT_NAMES = {"sim3": "Sim(3) Umeyama", "se3": "SE(3) Umeyama", "none": "no alignment"}


@dataclass(frozen=True)
class Trajectory:
    """Camera poses with their times.

    Raises:
        InputError: If the shapes disagree, there is no pose, or a value is not finite.
    """

    timestamps: FloatArray
    """(T,) seconds, not decreasing."""
    world_T_cam: FloatArray
    """(T, 4, 4) camera to world, metres."""

    def __post_init__(self) -> None:
        count = len(self.timestamps)
        if count == 0 or self.timestamps.shape != (count,) or self.world_T_cam.shape != (count, 4, 4):
            raise InputError(
                f"trajectory: timestamps {self.timestamps.shape} and poses {self.world_T_cam.shape} "
                "must be (T,) and (T, 4, 4) with T > 0"
            )
        bad = np.flatnonzero(~(np.isfinite(self.world_T_cam).all(axis=(1, 2)) & np.isfinite(self.timestamps)))
        if len(bad):
            raise InputError(f"trajectory: pose {bad[0]} has a value that is NaN or infinite")

    def __len__(self) -> int:
        return len(self.timestamps)

    def select(self, frames: IntArray) -> Trajectory:
        """Return the poses at the given indices."""
        return Trajectory(self.timestamps[frames], self.world_T_cam[frames])


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Trajectory errors; lengths in metres of the ground truth, angles in degrees."""

    protocol: str
    """How the numbers were computed."""
    ate_m: float
    """Root mean square distance of the camera centres after alignment."""
    rpe_translation_m: float | None
    """Root mean square translation of the relative pose error; None with fewer than two poses."""
    rpe_rotation_deg: float | None
    """Root mean square rotation angle of the relative pose error; None with fewer than two poses."""
    scale: float
    """Reference length per estimate length, as the alignment found it."""
    degenerate: Degeneracy
    """Why the centres did not determine the alignment, or 'none'."""
    poses: int
    """Pose pairs compared."""
    path_length_estimate_m: float
    """Length of the estimated path before alignment."""
    path_length_reference_m: float
    """Length of the true path."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def path_length(world_T_cam: FloatArray) -> float:
    """Return the length of the polyline through the camera centres of (T, 4, 4) poses, metres."""
    return float(np.linalg.norm(np.diff(world_T_cam[:, :3, 3], axis=0), axis=1).sum())


def associate(
    estimate: Trajectory, reference: Trajectory, *, tolerance_s: float = 0.01
) -> tuple[Trajectory, Trajectory]:
    """Pair poses by time: each pose of the shorter trajectory takes the nearest one of the longer.

    Returns:
        Both trajectories, reduced to the pairs whose times differ by no more than ``tolerance_s``.

    Raises:
        InputError: If no pair is that close.
    """
    swap = len(estimate) > len(reference)
    short, long = (reference, estimate) if swap else (estimate, reference)
    after = np.clip(np.searchsorted(long.timestamps, short.timestamps, side="right"), 0, len(long) - 1)
    before = np.maximum(after - 1, 0)
    ahead = np.abs(long.timestamps[after] - short.timestamps)
    behind = np.abs(short.timestamps - long.timestamps[before])
    nearest = np.where(ahead < behind, after, before)
    close = np.flatnonzero(np.minimum(ahead, behind) <= tolerance_s)
    if len(close) == 0:
        raise InputError(
            f"no two poses lie within {tolerance_s:g} s: the estimate covers "
            f"{estimate.timestamps[0]:.3f} to {estimate.timestamps[-1]:.3f} s, the ground truth "
            f"{reference.timestamps[0]:.3f} to {reference.timestamps[-1]:.3f} s"
        )
    pair = short.select(close), long.select(nearest[close])
    return (pair[1], pair[0]) if swap else pair


def evaluate_trajectory(
    estimate: FloatArray, reference: FloatArray, *, alignment: AlignmentMode = "sim3", delta: int = 1
) -> TrajectoryMetrics:
    """Score camera poses against the truth, frame by frame.

    The estimate is aligned once, over all poses; both errors are taken from the aligned estimate. The
    relative error over ``delta`` frames is inv(inv(Q_i) Q_j) inv(P_i) P_j, for every i (all pairs).

    Args:
        estimate: (T, 4, 4) camera to world.
        reference: (T, 4, 4) camera to world, metres.
        alignment: Similarity, rigid motion, or none.
        delta: Distance of the relative error's pairs, frames.

    Raises:
        InputError: If the shapes disagree or a pose is not finite.
    """
    if estimate.shape != reference.shape or estimate.ndim != 3 or estimate.shape[1:] != (4, 4) or not len(estimate):
        raise InputError(f"trajectory: poses {estimate.shape} and {reference.shape} must both be (T, 4, 4), T > 0")
    for name, poses in (("estimate", estimate), ("ground truth", reference)):
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if len(bad):
            raise InputError(f"trajectory: pose {bad[0]} of the {name} has a value that is NaN or infinite")
    if alignment == "none":
        similarity = Similarity.identity()
    else:
        similarity = align_trajectories(estimate, reference, with_scale=alignment == "sim3")
    aligned = similarity.apply_poses(estimate)
    distance = np.linalg.norm(aligned[:, :3, 3] - reference[:, :3, 3], axis=1)
    translation, rotation = relative_pose_errors(aligned, reference, delta=delta)
    plural = "" if delta == 1 else "s"
    return TrajectoryMetrics(
        protocol=f"{_ALIGNMENT_NAMES[alignment]}, RMSE, RPE delta {delta} frame{plural}, all pairs",
        ate_m=root_mean_square(distance),
        rpe_translation_m=root_mean_square(translation) if len(translation) else None,
        rpe_rotation_deg=root_mean_square(rotation) if len(rotation) else None,
        scale=similarity.scale,
        degenerate=similarity.degenerate,
        poses=len(estimate),
        path_length_estimate_m=path_length(estimate),
        path_length_reference_m=path_length(reference),
    )


def relative_pose_errors(
    estimate: FloatArray, reference: FloatArray, *, delta: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Return the relative errors of all pairs ``delta`` frames apart: (T - delta,) metres and degrees."""
    if len(estimate) <= delta:
        return np.zeros(0), np.zeros(0)
    motion_estimate = se3.inverse(estimate[:-delta]) @ estimate[delta:]
    motion_reference = se3.inverse(reference[:-delta]) @ reference[delta:]
    error = se3.inverse(motion_reference) @ motion_estimate
    angle: FloatArray = np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())
    return np.linalg.norm(error[:, :3, 3], axis=1), angle


def root_mean_square(values: FloatArray) -> float:
    """Return sqrt(mean(values^2)) of a non-empty array."""
    return float(np.sqrt(np.mean(np.square(values))))
