"""Least-squares similarity between two point sets (Umeyama 1991), with an answer for degenerate ones.

Positions alone fix the rotation only when they span a plane. Cameras that stand still or move along a
line leave it open, wholly or about that line; the open part is then taken from the orientations, if given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3

Degeneracy: TypeAlias = Literal["none", "collinear", "motionless_estimate", "motionless_reference", "no_points"]
"""Why positions did not determine the whole alignment."""

_MOTIONLESS_M = 1e-8
_RELATIVE_ROUNDING = 1e-15
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Similarity:
    """The map ``x -> scale * rotation @ x + translation`` from the estimate's world to the reference's."""

    rotation: FloatArray
    """(3, 3)."""
    translation: FloatArray
    """(3,) meters of the reference."""
    scale: float
    """Reference length per estimate length."""
    degenerate: Degeneracy = "none"

    @classmethod
    def identity(cls) -> Similarity:
        """Return the map that changes nothing."""
        return cls(np.eye(3), np.zeros(3), 1.0)

    def apply(self, points: FloatArray) -> FloatArray:
        """Map points (..., 3), meters; NaN stays NaN."""
        result: FloatArray = self.scale * (points @ self.rotation.T) + self.translation
        return result

    def apply_poses(self, world_T_cam: FloatArray) -> FloatArray:
        """Map camera poses (T, 4, 4): centers as points, orientations by the rotation alone."""
        out = np.array(world_T_cam, dtype=np.float64)
        out[:, :3, :3] = self.rotation @ world_T_cam[:, :3, :3]
        out[:, :3, 3] = self.apply(world_T_cam[:, :3, 3])
        return out


def align_points(
    estimate: FloatArray,
    reference: FloatArray,
    *,
    with_scale: bool = True,
    estimate_rotations: FloatArray | None = None,
    reference_rotations: FloatArray | None = None,
) -> Similarity:
    """Return the Sim(3) (or SE(3)) that maps ``estimate`` onto ``reference`` with the least squared error.

    A degenerate input never raises: the rotation the positions leave open comes from the orientations
    (or is the smallest one), and the scale is 1 where either set does not move. A reference at rest gives
    scale 1 on purpose: the least-squares scale is then 0 and would hide any error of the estimate.

    Args:
        estimate: (N, 3) points; pairs with a value that is not finite are left out.
        reference: (N, 3) their counterparts, meters.
        with_scale: Estimate the scale (Sim(3)); else keep 1 (SE(3)).
        estimate_rotations: (N, 3, 3) camera orientations, used only where positions leave the rotation open.
        reference_rotations: (N, 3, 3) their counterparts.

    Raises:
        InputError: If the shapes disagree.
    """
    if estimate.shape != reference.shape or estimate.ndim != 2 or estimate.shape[1] != 3:
        raise InputError(f"alignment: point sets {estimate.shape} and {reference.shape} must both be (N, 3)")
    finite = np.isfinite(estimate).all(axis=1) & np.isfinite(reference).all(axis=1)
    x, y = estimate[finite], reference[finite]
    if len(x) == 0:
        return Similarity(np.eye(3), np.zeros(3), 1.0, "no_points")
    spread = np.zeros((3, 3))
    if estimate_rotations is not None and reference_rotations is not None:
        spread = np.einsum("nij,nkj->ik", reference_rotations[finite], estimate_rotations[finite])
        spread = np.where(np.isfinite(spread), spread, 0.0)

    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    if _motionless(x, mean_x) or _motionless(y, mean_y):
        rotation, scale = _nearest_rotation(spread), 1.0
        flag: Degeneracy = "motionless_estimate" if _motionless(x, mean_x) else "motionless_reference"
        return Similarity(rotation, mean_y - rotation @ mean_x, scale, flag)

    u, d, vt = np.linalg.svd((y - mean_y).T @ (x - mean_x) / len(x))
    if d[1] <= _RANK_TOLERANCE * d[0] + _rounding(x) * _extent(y, mean_y) + _rounding(y) * _extent(x, mean_x):
        flag = "collinear"
        rotation = _rotation_about_line(vt[0], u[:, 0], spread)
        strength = d[0]
    else:
        flag = "none"
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
        rotation = (u * sign) @ vt
        strength = float(d @ sign)
    scale = float(strength / ((x - mean_x) ** 2).sum(axis=1).mean()) if with_scale else 1.0
    return Similarity(rotation, mean_y - scale * (rotation @ mean_x), scale, flag)


def align_trajectories(estimate: FloatArray, reference: FloatArray, *, with_scale: bool = True) -> Similarity:
    """Align camera poses (T, 4, 4) by their centers, with their orientations for what centers leave open."""
    return align_points(
        estimate[:, :3, 3],
        reference[:, :3, 3],
        with_scale=with_scale,
        estimate_rotations=estimate[:, :3, :3],
        reference_rotations=reference[:, :3, :3],
    )


def align_first_pose(estimate: FloatArray, reference: FloatArray) -> Similarity:
    """Return the rigid map that lays the estimate's first pose (4, 4) on the reference's; scale 1."""
    transform = se3.orthonormalize(reference @ se3.inverse(estimate))
    return Similarity(transform[:3, :3], transform[:3, 3], 1.0)


def _extent(points: FloatArray, mean: FloatArray) -> float:
    """Return the root mean square distance of points from their mean."""
    return float(np.sqrt(((points - mean) ** 2).sum(axis=1).mean()))


def _rounding(points: FloatArray) -> float:
    """Return how far rounding can have moved points with coordinates of this size."""
    return _RELATIVE_ROUNDING * float(np.abs(points).max())


def _motionless(points: FloatArray, mean: FloatArray) -> bool:
    """Tell whether points move no more than rounding can fake."""
    return _extent(points, mean) <= max(_MOTIONLESS_M, _rounding(points))


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotation closest to a sum of rotations; the identity where the sum says nothing."""
    if not np.abs(matrix).max() > 0.0:
        return np.eye(3)
    u, _, vt = np.linalg.svd(matrix)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    result: FloatArray = (u * sign) @ vt
    return result


def _rotation_about_line(source: FloatArray, target: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the rotation taking unit ``source`` to ``target`` that agrees best with the orientations.

    All such rotations are Rot(target, angle) @ R0; the angle maximizes trace(R^T spread) in closed form.
    """
    axis = np.cross(source, target)
    sine, cosine = float(np.linalg.norm(axis)), float(source @ target)
    if sine < 1e-12:
        axis = np.cross(source, np.eye(3)[int(np.argmin(np.abs(source)))])
    axis = axis / np.linalg.norm(axis)
    smallest = se3.so3_exp(axis * np.arctan2(sine, cosine))
    rest = spread @ smallest.T
    angle = np.arctan2((se3.skew(target) * rest).sum(), np.trace(rest) - target @ rest @ target)
    result: FloatArray = se3.so3_exp(target * angle) @ smallest
    return result
