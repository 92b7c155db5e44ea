"""Camera trajectory errors: absolute (ATE) and relative (RPE), by the protocol common in the field."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.alignment import Degeneracy, Similarity, align_trajectories

AlignmentMode: TypeAlias = Literal["sim3", "se3", "none"]

_ALIGNMENT_NAMES = {"sim3": "Sim(3) Umeyama", "se3": "SE(3) Umeyama", "none": "no alignment"}


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Trajectory errors; lengths in meters of the ground truth, angles in degrees."""

    protocol: str
    """How the numbers were computed."""
    ate_m: float
    """Root mean square distance of the camera centers after alignment."""
    rpe_translation_m: float | None
    """Root mean square translation of the relative pose error; None with fewer than two poses."""
    rpe_rotation_deg: float | None
    """Root mean square rotation angle of the relative pose error; None with fewer than two poses."""
    scale: float
    """Reference length per estimate length, as the alignment found it."""
    degenerate: Degeneracy
    """Why the centers did not determine the alignment, or 'none'."""
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
    """Return the length of the polyline through the camera centers of (T, 4, 4) poses, meters."""
    return float(np.linalg.norm(np.diff(world_T_cam[:, :3, 3], axis=0), axis=1).sum())


def evaluate_trajectory(
    estimate: FloatArray, reference: FloatArray, *, alignment: AlignmentMode = "sim3", delta: int = 1
) -> TrajectoryMetrics:
    """Score camera poses against the truth, frame by frame.

    The estimate is aligned once, over all poses; both errors are taken from the aligned estimate. The
    relative error over ``delta`` frames is inv(inv(Q_i) Q_j) inv(P_i) P_j, for every i (all pairs).

    Args:
        estimate: (T, 4, 4) camera to world.
        reference: (T, 4, 4) camera to world, meters.
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
    """Return the relative errors of all pairs ``delta`` frames apart: (T - delta,) meters and degrees."""
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
