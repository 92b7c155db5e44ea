"""Reprojection residuals of a finished run, and what they say about the certainty of its landmarks.

The residual of an observation is ``z_{k,t} - pi_K(R_t^T (p - c_t))``, p the landmark or the dynamic point in frame t.
With J its derivative by p and sigma the spread of the residuals, the covariance of a landmark with cameras held is
``sigma^2 (sum J^T J)^-1``: what the rays alone say about it, without the depth cue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, rows_by_group
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.reconstruction import Reconstruction


@dataclass(frozen=True)
class Residuals:
    """N observations of landmarks and dynamic points."""

    row: IntArray
    """(N,) row of the landmark, or of the trajectory where ``is_dynamic``."""
    frame: IntArray
    """(N,)."""
    uv: FloatArray
    """(N, 2) observed pixel."""
    error: FloatArray
    """(N, 2) observed minus projected, px."""
    depth: FloatArray
    """(N,) depth of the point in its camera, meters; ``error`` means nothing where it is not above the near plane."""
    is_dynamic: BoolArray
    """(N,)."""

    @property
    def norm(self) -> FloatArray:
        """(N,) length of the residuals, px."""
        return np.asarray(np.linalg.norm(self.error, axis=1))

    def per_frame(self, num_frames: int, quantile: float, *, dynamic: bool) -> FloatArray:
        """Return a quantile of the lengths of each frame, (T,) px; NaN where a frame has none."""
        chosen = self.is_dynamic == dynamic
        frame, norm = self.frame[chosen], self.norm[chosen]
        parts = rows_by_group(frame, num_frames)
        return np.array([np.quantile(norm[rows], quantile) if len(rows) else np.nan for rows in parts])


def reprojection_residuals(reconstruction: Reconstruction, labelled: LabelledTracks) -> Residuals:
    """Compute the residual of every trusted observation of a landmark or dynamic point.

    Observations that bundle adjustment dropped for their large residual are among them: runs do not list them.

    Args:
        reconstruction: Cameras and points.
        labelled: The tracks that it was made from.
    """
    static_row, static_frame = np.nonzero(labelled.weight[reconstruction.landmark_track] > 0)
    moving_row, moving_frame = np.nonzero(
        reconstruction.dynamic_observed & labelled.tracks.visible[reconstruction.dynamic_track]
    )
    row = np.concatenate([static_row, moving_row]).astype(np.int64)
    frame = np.concatenate([static_frame, moving_frame]).astype(np.int64)
    points = np.concatenate(
        [reconstruction.landmarks[static_row], reconstruction.dynamic_points[moving_row, moving_frame]]
    )
    track = np.concatenate(
        [reconstruction.landmark_track[static_row], reconstruction.dynamic_track[moving_row]]
    ).astype(np.int64)
    uv = labelled.tracks.uv[track, frame].astype(np.float64)
    seen = np.asarray(np.isfinite(uv).all(axis=1))
    row, frame, points, uv = row[seen], frame[seen], points[seen], uv[seen]
    is_dynamic = (np.arange(len(seen)) >= len(static_row))[seen]
    in_camera = world_to_camera(reconstruction.world_T_cam[frame], points)
    intrinsics = reconstruction.frame_intrinsics[frame]
    error = uv - reconstruction.lens.real_pixels(intrinsics, np.asarray(project(intrinsics, in_camera)))
    return Residuals(row, frame, uv, error, in_camera[:, 2], is_dynamic)


def landmark_sigma(reconstruction: Reconstruction, residuals: Residuals) -> FloatArray:
    """Return the standard deviation of each landmark's position from its rays alone, (N,) meters.

    See the module's docstring; infinite where the rays do not determine it (one view, no parallax).
    """
    static = ~residuals.is_dynamic
    row, frame = residuals.row[static], residuals.frame[static]
    count = len(reconstruction.landmarks)
    if len(row) == 0:
        return np.full(count, np.inf)
    sigma = robust_sigma(residuals.error[static])
    poses = reconstruction.world_T_cam[frame]
    x = world_to_camera(poses, reconstruction.landmarks[row])
    fx, fy = reconstruction.frame_intrinsics[frame, :2].T
    g = 1.0 / np.maximum(x[:, 2], NEAR_PLANE)
    by_camera_point = np.zeros((len(row), 2, 3))
    by_camera_point[:, 0, 0], by_camera_point[:, 0, 2] = fx * g, -fx * x[:, 0] * g**2
    by_camera_point[:, 1, 1], by_camera_point[:, 1, 2] = fy * g, -fy * x[:, 1] * g**2
    jacobian = by_camera_point @ np.swapaxes(poses[:, :3, :3], 1, 2)
    information = np.zeros((count, 3, 3))
    np.add.at(information, row, np.swapaxes(jacobian, 1, 2) @ jacobian)
    values = np.linalg.eigvalsh(information)
    determined = values[:, 0] > 1e-9 * np.maximum(values[:, 2], 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.where(determined, (1.0 / np.where(determined[:, None], values, 1.0)).sum(axis=1), np.inf)
    return sigma * np.sqrt(variance)
