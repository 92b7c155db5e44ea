r"""Two views: how much of their motion a rotation leaves unexplained, and the pose between them.

A camera that only turns moves every pixel by ``K R K^-1``, whatever the depth. The parallax of two frames is

    min over R and focal length f of  median_k | z'_k - pi_K(R pi_K^-1(z_k)) |      [px]

and depth can be seen only where it is well above the noise of the tracks. The focal length is part of the
minimum, because with a wrong one a pure rotation looks like parallax. Before a wall that fills most of the image the
median says little, as moving along it looks like turning; then the quarter of the tracks that is left most tells.

Sources: rotation by Kabsch (1976); essential matrix by Nister's five points with MAGSAC (OpenCV).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.structure.consensus import essential_matrix
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, unproject

_FOCAL_FACTORS = np.geomspace(0.5, 2.0, 7)
_FINER_FACTORS = np.array([0.91, 0.955, 1.045, 1.09])
"""Around the best of those, where what a rotation leaves is little ..."""
_DOUBTFUL_PX = 5.0
"""... that is, up to this."""
_REWEIGHTINGS = 4
"""Reweighted solves of the rotation fit."""
_FAR = 50.0 * float(np.radians(0.5))
"""Points tell which of four poses is right up to so many baselines, over the least angle of rays (rad): OpenCV's own 50
at half a degree."""
_CONFIDENCE = 0.9999
"""Probability of a sample without outliers at which trials end early."""


@dataclass(frozen=True)
class RelativePose:
    """The second camera seen from the first, with a baseline of length 1."""

    first_T_second: FloatArray
    """(4, 4) pose of the second camera in the first one's frame."""
    inlier: BoolArray
    """(N,) tracks that agree and lie in front of both cameras."""


def fit_rotation(uv_first: FloatArray, uv_second: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """Return the rotation second_R_first (3, 3) that explains most of the motion of N pixels.

    It is fitted robustly: reweighted towards the median distance.

    Args:
        uv_first: (N, 2) px.
        uv_second: (N, 2) px.
        intrinsics: (4,) px.
    """
    rotation, _ = _fit_rotations(uv_first, uv_second, intrinsics[None])
    first: FloatArray = rotation[0]
    return first


class Parallax(NamedTuple):
    """Motion that no rotation explains, px."""

    median: float
    upper: float
    """What a quarter of the tracks exceeds."""


def parallax(uv_first: FloatArray, uv_second: FloatArray, intrinsics: FloatArray, *, known_focal: bool) -> Parallax:
    """Return the motion of N pixel pairs that no rotation explains.

    Args:
        uv_first: (N, 2) px.
        uv_second: (N, 2) px.
        intrinsics: (4,) px; the focal lengths are varied from half to twice unless ``known_focal``.
        known_focal: Whether the focal lengths are exact.
    """
    if known_focal:
        return left_by_rotations(uv_first, uv_second, intrinsics[None])[0]
    left = left_by_rotations(uv_first, uv_second, multiples(intrinsics, _FOCAL_FACTORS))
    least = min(left)
    if least.median > _DOUBTFUL_PX:
        return least
    # A camera that turns far leaves pixels at a focal length between two factors.
    finer = _FOCAL_FACTORS[left.index(least)] * _FINER_FACTORS
    return min(least, *left_by_rotations(uv_first, uv_second, multiples(intrinsics, finer)))


def multiples(intrinsics: FloatArray, factors: FloatArray) -> FloatArray:
    """Return intrinsics (F, 4) px with focal lengths multiplied by F factors."""
    scale = np.ones((len(factors), 4))
    scale[:, :2] = factors[:, None]
    return np.asarray(intrinsics * scale)


def left_by_rotations(uv_first: FloatArray, uv_second: FloatArray, intrinsics: FloatArray) -> list[Parallax]:
    """Return what a rotation leaves of the motion of N pixel pairs (N, 2), px, with each of F intrinsics (F, 4)."""
    _, distance = _fit_rotations(uv_first, uv_second, intrinsics)
    return [Parallax(*map(float, part)) for part in np.quantile(distance, [0.5, 0.75], axis=1).T]


def _fit_rotations(
    uv_first: FloatArray, uv_second: FloatArray, intrinsics: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fit a rotation to N pixel pairs (N, 2) for each of F intrinsics (F, 4), all at once.

    Returns:
        Rotations (F, 3, 3) of the second camera seen from the first, and the distances (F, N) px that each leaves.
    """
    a, b = _rays(uv_first, intrinsics), _rays(uv_second, intrinsics)
    weight = np.ones(a.shape[:2])
    rotation, distance = np.tile(np.eye(3), (len(a), 1, 1)), np.full(a.shape[:2], np.inf)
    for _ in range(_REWEIGHTINGS):
        u, _, vt = np.linalg.svd((b * weight[..., None]).swapaxes(1, 2) @ a)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotation = u @ vt
        off = project(intrinsics[:, None], a @ rotation.swapaxes(1, 2)) - uv_second
        distance = np.hypot(off[..., 0], off[..., 1])
        left = np.median(distance, axis=1)
        weight = 1.0 / np.maximum(distance / np.maximum(left, 1e-3)[:, None], 1.0)
    return rotation, distance


def relative_pose(
    uv_first: FloatArray, uv_second: FloatArray, intrinsics: FloatArray, threshold_px: float, max_trials: int,
    min_angle_deg: float,
) -> RelativePose | None:  # fmt: skip
    """Find the pose between two views by a robust essential matrix; None if there is none.

    Args:
        uv_first: (N, 2) px.
        uv_second: (N, 2) px.
        intrinsics: (4,) px.
        threshold_px: Distance to the epipolar line up to which a pair agrees.
        max_trials: Trials at most.
        min_angle_deg: Points whose rays meet at less than about twice this agree with no pose.

    Returns:
        The pose; the same input gives the same result (OpenCV's MAGSAC draws from a fixed seed).
    """
    if len(uv_first) < 8:
        return None
    rays = [unproject(intrinsics, uv, np.ones(len(uv)))[:, :2] for uv in (uv_first, uv_second)]
    found = essential_matrix(rays[0], rays[1], threshold_px / float(np.mean(intrinsics[:2])), _CONFIDENCE, max_trials)
    if found is None:
        return None
    essential, agrees = found
    # The mask is changed in place: what lies behind a camera, or too far away to tell, goes out.
    agreeing = agrees[:, None].astype(np.uint8)
    far = _FAR / float(np.radians(min_angle_deg))
    count, rotation, translation, mask, _ = cv2.recoverPose(
        essential, rays[0], rays[1], np.eye(3), distanceThresh=far, mask=agreeing
    )
    if count < 8:
        return None
    second_T_first = np.eye(4)
    second_T_first[:3, :3], second_T_first[:3, 3] = rotation, translation[:, 0]
    pose = se3.inverse(se3.orthonormalize(second_T_first))
    return RelativePose(pose, np.asarray(mask[:, 0] > 0))


def _rays(uv: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """Return unit rays (F, N, 3) of pixels (N, 2) for intrinsics (F, 4)."""
    rays: FloatArray = unproject(intrinsics[:, None], uv[None], np.ones(len(uv)))
    unit: FloatArray = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    return unit
