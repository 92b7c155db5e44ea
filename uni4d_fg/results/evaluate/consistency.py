r"""Whether covariances of the cameras are as large as the errors: the normalized estimation error squared (NEES).

The covariance of a result is that of each pose's step in its own frame relative to the first camera, so the error is
taken in the same gauge: with the first cameras of both laid on each other,

    e_i = Log((Q_0^{-1} Q_i)^{-1} (P_0^{-1} P_i)),     NEES_i = e_i^T (C_i + C_truth)^{-1} e_i,

for estimates P and true poses Q. A covariance that holds has NEES_i ~ chi-square with six degrees of freedom: mean six,
95 % of the frames below 12.59. Poses of one run err alike, so that a mean over its frames has the spread of a few
samples only, not of as many as there are frames: judge means over runs.

The length of a meter is a gauge too where only a depth cue tells it, whose scale nothing can check. The protocol
``first camera and scale`` multiplies the lengths of the estimate, and of its covariances, by the one scale that makes
the errors likeliest (taking frames for independent); as the covariance keeps its part for the scale, the mean may then
be as low as 5.
Source: Bar-Shalom, Li and Kirubarajan 2001, "Estimation with applications to tracking and navigation", section 5.4.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import se3_log

DIMENSIONS = 6
_LIMITS = {share: float(chi2.ppf(share, DIMENSIONS)) for share in (0.95, 0.99)}
_SCALE_RANGE = float(np.log(3.0))


@dataclass(frozen=True)
class ConsistencyMetrics:
    """How errors of the poses compare with their covariances."""

    protocol: str
    """The gauge in which errors were taken."""
    mean: float
    """Mean NEES per dimension; 1 where covariances hold, above where they are too small."""
    median: float
    """Median NEES as a multiple of the median of chi-square; less moved by single frames."""
    rotation: float
    """Mean NEES per dimension of the rotations alone."""
    position: float
    """Mean NEES per dimension of the positions alone."""
    within_95: float
    """Part of the frames within the region that holds 95 %."""
    within_99: float
    """Part of the frames within the region that holds 99 %."""
    scale: float
    """True length per length of the estimate that was used; 1 where none was."""
    frames: int
    """Frames compared: those with a true pose and a covariance, without the first."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain Python values."""
        return asdict(self)


def relative_errors(estimate: FloatArray, reference: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return the twist (rad, m) of each estimated pose from the true one, both relative to their first, (T, 6).

    Args:
        estimate: (T, 4, 4) camera to world.
        reference: (T, 4, 4) true ones.
        scale: Lengths of the estimate are multiplied by it.
    """
    found = se3.inverse(estimate[:1]) @ estimate
    found[:, :3, 3] *= scale
    truth = se3.inverse(reference[:1]) @ reference
    result: FloatArray = se3_log(se3.inverse(truth) @ found)
    return result


def nees(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the normalized squared errors (N,) of errors (N, d) with covariances (N, d, d)."""
    result: FloatArray = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
    return result


def evaluate_consistency(
    estimate: FloatArray,
    reference: FloatArray,
    covariance: FloatArray,
    *,
    with_scale: bool = True,
    truth_sigma: tuple[float, float] = (0.0, 0.0),
) -> ConsistencyMetrics | None:
    """Compare errors of poses with their covariances, see the module's docstring.

    Args:
        estimate: (T, 4, 4) camera to world; the first is the gauge of the covariances.
        reference: (T, 4, 4) true ones, meters.
        covariance: (T, 6, 6) of each pose's body-frame twist (rotation rad, translation m); zero where held, NaN where
            unknown.
        with_scale: Take the scale of the estimate for a gauge.
        truth_sigma: Standard deviation of each component of the true poses' own rotations (rad) and positions (m).

    Returns:
        None if no frame but the first has a covariance.

    Raises:
        InputError: If the shapes disagree or a pose is not finite.
    """
    count = len(estimate)
    shapes = (estimate.shape, reference.shape, covariance.shape)
    if shapes != ((count, 4, 4), (count, 4, 4), (count, 6, 6)) or not count:
        raise InputError(f"consistency: poses {shapes[0]}, {shapes[1]} and covariances {shapes[2]} do not fit together")
    if not (np.isfinite(estimate).all() and np.isfinite(reference).all()):
        raise InputError("consistency: a pose has a value that is NaN or infinite")
    known = _known(covariance)
    if not known.any():
        return None
    # The true relative pose has the errors of two poses.
    own = 2.0 * np.diag(np.repeat(np.square(truth_sigma), 3))
    scale = 1.0
    if with_scale:
        scale = _likeliest_scale(estimate, reference, covariance[known] + own, known)
    length = np.repeat([1.0, scale], 3)
    spread = length[:, None] * covariance[known] * length + own
    errors = relative_errors(estimate, reference, scale)[known]
    values = nees(errors, spread)
    return ConsistencyMetrics(
        protocol="NEES / 6, " + ("first camera and scale" if with_scale else "first camera"),
        mean=float(values.mean()) / DIMENSIONS,
        median=float(np.median(values) / chi2.median(DIMENSIONS)),
        rotation=float(nees(errors[:, :3], spread[:, :3, :3]).mean()) / 3.0,
        position=float(nees(errors[:, 3:], spread[:, 3:, 3:]).mean()) / 3.0,
        within_95=float((values < _LIMITS[0.95]).mean()),
        within_99=float((values < _LIMITS[0.99]).mean()),
        scale=scale,
        frames=len(values),
    )


def _known(covariance: FloatArray) -> BoolArray:
    """Return which frames (T,) have a covariance of full rank; the first is the gauge."""
    finite = np.isfinite(covariance).all(axis=(1, 2))
    known: BoolArray = np.asarray(finite & (np.einsum("nii->ni", np.nan_to_num(covariance)).min(axis=1) > 0.0))
    known[0] = False
    return known


def _likeliest_scale(estimate: FloatArray, reference: FloatArray, spread: FloatArray, known: BoolArray) -> float:
    """Return the scale with the smallest sum of normalized squared errors; 1 where the camera does not move."""
    moved = np.linalg.norm(estimate[:, :3, 3] - estimate[0, :3, 3], axis=1)
    if moved.max() < 1e-9:
        return 1.0

    def total(log_scale: float) -> float:
        return float(nees(relative_errors(estimate, reference, np.exp(log_scale))[known], spread).sum())

    found = minimize_scalar(total, bounds=(-_SCALE_RANGE, _SCALE_RANGE), method="bounded", options={"xatol": 1e-7})
    return float(np.exp(found.x))
