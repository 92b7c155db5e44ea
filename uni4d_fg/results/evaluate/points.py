"""Errors of reconstructed points against their true positions, in the true world."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry.alignment import Similarity


@dataclass(frozen=True)
class PointMetrics:
    """Distances between points and their true positions; None where no point could be scored."""

    protocol: str
    """Which points were scored and how the worlds were aligned."""
    rmse_m: float | None
    """Root mean square distance, meters."""
    median_m: float | None
    """Median distance, meters."""
    points: int
    """Positions scored."""
    missing_estimates: int
    """Selected positions with truth but without an estimate; not scored."""
    missing_truth: int
    """Selected positions with an estimate but without truth; not scored."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def evaluate_points(
    estimate: FloatArray,
    reference: FloatArray,
    mask: BoolArray | None = None,
    alignment: Similarity | None = None,
    *,
    protocol: str = "no alignment, RMSE",
) -> PointMetrics:
    """Score points, or trajectories of points, against the truth.

    Args:
        estimate: (..., 3), e.g. (M, T, 3) trajectories or (N, 3) landmarks, meters; NaN where not estimated.
        reference: (..., 3) true world positions, meters; NaN where unknown.
        mask: (...) True where a position is to be scored; None selects all.
        alignment: Map from the estimate's world to the true one; None leaves the estimate as it is.
        protocol: Text for the result.

    Raises:
        InputError: If the shapes disagree.
    """
    if estimate.shape != reference.shape or estimate.shape[-1:] != (3,):
        raise InputError(f"points: {estimate.shape} and {reference.shape} must be equal and end in 3")
    if mask is not None and mask.shape != estimate.shape[:-1]:
        raise InputError(f"points: mask {mask.shape} must be {estimate.shape[:-1]}")
    selected = np.ones(estimate.shape[:-1], dtype=bool) if mask is None else mask
    estimated = np.isfinite(estimate).all(axis=-1) & selected
    known = np.isfinite(reference).all(axis=-1) & selected
    both = estimated & known
    aligned = estimate[both] if alignment is None else alignment.apply(estimate[both])
    distance = np.linalg.norm(aligned - reference[both], axis=-1)
    return PointMetrics(
        protocol=protocol,
        rmse_m=float(np.sqrt(np.mean(distance**2))) if len(distance) else None,
        median_m=float(np.median(distance)) if len(distance) else None,
        points=len(distance),
        missing_estimates=int((known & ~estimated).sum()),
        missing_truth=int((estimated & ~known).sum()),
    )
