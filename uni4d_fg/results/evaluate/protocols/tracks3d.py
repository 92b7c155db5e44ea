"""Tracking in 3D, by TAPVid-3D: average Jaccard (3D-AJ), points within thresholds (APD), occlusion accuracy (OA).

S. Koppula et al., "TAPVid-3D: a benchmark for tracking any point in 3D", NeurIPS 2024. A threshold of n pixels is a
distance of n pixels at the true depth.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.errors import InputError

Scaling: TypeAlias = Literal["median", "mean", "none"]
THRESHOLDS_PX = (1, 2, 4, 8, 16)


@dataclass(frozen=True)
class Track3dScore:
    """One video; shares in [0, 1]."""

    average_jaccard: float
    """3D-AJ: true positives over true positives, false positives and false negatives, mean over thresholds."""
    points_within: float
    """APD: share of the visible points within a threshold, mean over thresholds."""
    occlusion_accuracy: float
    """OA."""
    jaccard: dict[str, float]
    """Per threshold, px."""
    within: dict[str, float]
    """Per threshold, px."""
    scaling: Scaling
    tracks: int

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def score_tracks(
    estimate: FloatArray,
    visible_estimate: BoolArray,
    truth: FloatArray,
    visible_truth: BoolArray,
    intrinsics: FloatArray,
    scaling: Scaling = "median",
) -> Track3dScore | None:
    """Score point tracks.

    Args:
        estimate: (K, T, 3) in the camera of their frame; NaN where there is none, which counts as far away.
        visible_estimate: (K, T).
        truth: (K, T, 3) in the camera of their frame, meters.
        visible_truth: (K, T).
        intrinsics: (4,) fx, fy, cx, cy, px, of the true camera.
        scaling: How the estimate is brought to the truth's scale: by the ratio of the medians (or means) of the
            distances from the camera, of what is visible in both; or not.

    Returns:
        The score; None if nothing is visible in truth.

    Raises:
        InputError: If the shapes disagree.
    """
    shape = visible_truth.shape
    if {estimate.shape, truth.shape} != {(*shape, 3)} or visible_estimate.shape != shape:
        raise InputError(f"tracks: {estimate.shape} and {truth.shape} must both be {(*shape, 3)}")
    if not visible_truth.any():
        return None
    points = np.where(np.isfinite(estimate), estimate, 0.0)
    true_points = np.where(np.isfinite(truth), truth, 0.0)
    both = visible_truth & visible_estimate
    scale = 1.0
    if scaling != "none" and both.any():
        reduce = np.median if scaling == "median" else np.mean
        lengths = [np.maximum(np.linalg.norm(p[both], axis=-1), 1e-6) for p in (true_points, points)]
        scale = float(reduce(lengths[0]) / reduce(lengths[1]))
    distance = np.linalg.norm(scale * points - true_points, axis=-1)
    pixel = true_points[..., 2] / np.sqrt(intrinsics[0] * intrinsics[1])
    jaccard, within = {}, {}
    for threshold in THRESHOLDS_PX:
        near = distance < np.abs(threshold * pixel)
        true_positives = int((near & both).sum())
        false_positives = int((visible_estimate & ~(near & visible_truth)).sum())
        jaccard[str(threshold)] = true_positives / (int(visible_truth.sum()) + false_positives)
        within[str(threshold)] = float((near & visible_truth).sum() / visible_truth.sum())
    return Track3dScore(
        float(np.mean(list(jaccard.values()))), float(np.mean(list(within.values()))),
        float((visible_estimate == visible_truth).mean()), jaccard, within, scaling, shape[0],
    )  # fmt: skip
