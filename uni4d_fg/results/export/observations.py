"""Which pixels saw which landmark, and how far off: what the static scene of a run rests on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.geometry.camera import NEAR_PLANE
from uni4d_fg.results.residuals import reprojection_residuals
from uni4d_fg.results.run import Run

MIN_OBSERVATIONS = 2
"""A landmark that fewer pixels agree with is left without observations."""


@dataclass(frozen=True)
class StaticObservations:
    """The observations of landmarks that agree with the result, by landmark, then by frame."""

    landmark: IntArray
    """(N,) row of the landmark."""
    frame: IntArray
    """(N,)."""
    uv: FloatArray
    """(N, 2) px, pixel centers at integers."""
    error: FloatArray
    """(N,) distance to the projected landmark, px."""

    def __len__(self) -> int:
        return len(self.frame)

    def landmark_error(self, num_landmarks: int) -> FloatArray:
        """Return each landmark's mean reprojection error, px; NaN where it has no observation."""
        count = np.bincount(self.landmark, minlength=num_landmarks)
        total = np.bincount(self.landmark, self.error, minlength=num_landmarks)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))

    def mean_error(self) -> float:
        """Return the mean over landmarks of their mean reprojection errors, px, as COLMAP reports it; NaN if none."""
        errors = self.landmark_error(int(self.landmark.max(initial=-1)) + 1)
        known = errors[np.isfinite(errors)]
        return float(known.mean()) if len(known) else float("nan")


def static_observations(run: Run) -> StaticObservations | None:
    """Collect the observations of the landmarks.

    They are those of ``labels.npz`` with a positive weight that lie in front of the camera and within
    ``bundle_adjustment.max_reprojection_px`` of their landmark, the bound at which the run dropped them.

    Returns:
        The observations, or None if the run kept no tracks.

    Raises:
        InputError: If a file of the run cannot be read.
    """
    if not run.folder.labels.exists():
        return None
    residuals = reprojection_residuals(run.reconstruction, run.need_labelled())
    error = residuals.norm
    keep = ~residuals.is_dynamic & (residuals.depth > NEAR_PLANE)
    keep &= error <= run.config.bundle_adjustment.max_reprojection_px
    count = np.bincount(residuals.row[keep], minlength=len(run.reconstruction.landmarks))
    # Rows of trajectories are no rows of landmarks, and are left out before the count is asked for.
    keep[keep] = count[residuals.row[keep]] >= MIN_OBSERVATIONS
    return StaticObservations(residuals.row[keep], residuals.frame[keep], residuals.uv[keep], error[keep])
