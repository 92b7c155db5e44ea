r"""The relative pose of two frames from matched features with depth.

Matches are mutual and pass the ratio test. A pose of the second camera in the axes of the first is found by RANSAC on
the first one's points, and refined on both ways,

    r = u_second - pi(T^{-1} s X_first),    r' = u_first - pi(T s' X_second),

by reweighted Gauss-Newton, with a scale s near one of each frame's depth, which is marginalized. The information counts
one pair of residuals for each cell of the image that has any: those of one cell share the errors of the depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.loops import LoopsConfig
from uni4d_fg.factors.static_reprojection import static_reprojection_jacobian
from uni4d_fg.geometry import se3
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.loops.places import Place

_CELLS = 4
_STEPS = 10
_MIN_SIGMA_PX = 0.3
_DEPTH_SIGMA = 0.03
"""Of what the depth of a frame is still scaled by, after its log-scale so far."""
_SCALE_PRIOR = np.diag(np.repeat([0.0, 1.0 / _DEPTH_SIGMA**2], [6, 2]))


@dataclass(frozen=True)
class Link:
    """Two frames that see the same place."""

    first: int
    second: int
    first_T_second: FloatArray
    """(4, 4) m."""
    information: FloatArray
    """(6, 6) of its twist."""
    inliers: int
    depth: float
    """Median depth of the place, m."""


def link(
    first: Place, second: Place, intrinsics: FloatArray, size: tuple[int, int], config: LoopsConfig
) -> Link | None:
    """Return the link of two frames; None if their features do not say one pose.

    Args:
        first: One frame.
        second: The other.
        intrinsics: (4,) px.
        size: (height, width) of the images, px.
        config: What a link needs.
    """
    here, there = _matches(first, second, config.match_ratio)
    both = np.isfinite(first.point[here, 2]) & np.isfinite(second.point[there, 2])
    here, there = here[both], there[both]
    if len(here) < config.min_inliers:
        return None
    limit = max(1.0, config.max_error_px * size[1] / 640.0)
    camera = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    found, rotation, translation, _ = cv2.solvePnPRansac(
        first.point[here], second.uv[there], camera, np.zeros(0), iterationsCount=200, reprojectionError=limit,
        confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not found:
        return None
    second_T_first = np.eye(4)
    second_T_first[:3, :3], second_T_first[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    pair = _Pair(first.point[here], second.point[there], first.uv[here], second.uv[there], intrinsics)
    guess = _Guess(se3.inverse(second_T_first), np.zeros(2))
    inlier: BoolArray = np.ones(len(here), dtype=bool)
    for _ in range(2):
        guess = pair.refined(guess, limit)
        inlier = pair.errors(guess).max(axis=1) < 2.0 * limit
    count = int(inlier.sum())
    if count < config.min_inliers or count < config.min_inlier_part * len(here):
        return None
    cells = min(_occupied(uv[inlier], size) for uv in (pair.first_uv, pair.second_uv))
    if cells < config.min_cells:
        return None
    information = pair.information(guess, inlier, cells)
    depth = float(np.median(pair.first_point[inlier, 2]))
    return Link(first.frame, second.frame, guess.pose, information, count, depth)


def _matches(first: Place, second: Place, ratio: float) -> tuple[IntArray, IntArray]:
    """Return the rows of mutual nearest features that pass the ratio test both ways."""
    if min(len(first.uv), len(second.uv)) < 3:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    distance = np.sqrt(np.maximum(2.0 - 2.0 * first.roots() @ second.roots().T, 0.0))
    rows = np.arange(len(distance))
    best = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[best] == rows
    nearest = distance[rows, best]
    second_best = np.partition(distance, 1, axis=1)[:, 1]
    other_best = np.partition(distance, 1, axis=0)[1][best]
    passed = np.flatnonzero(mutual & (nearest < ratio * np.minimum(second_best, other_best)))
    return passed, best[passed]


def _occupied(uv: FloatArray, size: tuple[int, int]) -> int:
    cell = np.clip((uv / np.array([size[1], size[0]]) * _CELLS).astype(int), 0, _CELLS - 1)
    return len(np.unique(cell[:, 0] * _CELLS + cell[:, 1]))


@dataclass(frozen=True)
class _Guess:
    """What is solved for."""

    pose: FloatArray
    """(4, 4) first_T_second."""
    log_scale: FloatArray
    """(2,) of both frames' depth."""


@dataclass(frozen=True)
class _Pair:
    first_point: FloatArray
    second_point: FloatArray
    first_uv: FloatArray
    second_uv: FloatArray
    intrinsics: FloatArray

    def linearized(self, guess: _Guess) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, 2, 2), both ways, and Jacobians (n, 2, 2, 8) for the twist and the log-scales."""
        intrinsics = np.broadcast_to(self.intrinsics, (len(self.first_uv), 4))
        back, turned = se3.inverse(guess.pose), se3.adjoint(guess.pose)
        residuals, jacobians = [], []
        for side, (camera, point, uv) in enumerate(
            ((guess.pose, self.first_point, self.second_uv), (back, self.second_point, self.first_uv))
        ):
            scaled = point * np.exp(guess.log_scale[side])
            cameras = np.broadcast_to(camera, (len(uv), 4, 4))
            residual, (by_pose, by_point, _) = static_reprojection_jacobian(cameras, scaled, intrinsics, uv=uv)
            jacobian = np.zeros((len(uv), 2, 8))
            jacobian[..., :6] = -by_pose @ turned if side else by_pose
            jacobian[..., 6 + side] = (by_point @ scaled[..., None])[..., 0]
            residuals.append(residual)
            jacobians.append(jacobian)
        return np.stack(residuals, axis=1), np.stack(jacobians, axis=1)

    def errors(self, guess: _Guess) -> FloatArray:
        """Return the errors (n, 2), px, both ways."""
        return np.asarray(np.linalg.norm(self.linearized(guess)[0], axis=2))

    def refined(self, guess: _Guess, scale: float) -> _Guess:
        """Minimize both ways with Cauchy's kernel of that scale, px."""
        for _ in range(_STEPS):
            r, j = self.linearized(guess)
            weight = 1.0 / (1.0 + (r**2).sum(axis=2) / scale**2)
            hessian = np.einsum("ns,nsra,nsrb->ab", weight, j, j) + _SCALE_PRIOR
            gradient = np.einsum("ns,nsra,nsr->a", weight, j, r)
            gradient[6:] += guess.log_scale / _DEPTH_SIGMA**2
            step = -np.linalg.solve(hessian + 1e-9 * np.diag(np.diag(hessian)), gradient)
            pose = se3.orthonormalize(se3.retract(guess.pose, step[:6]))
            guess = _Guess(pose, guess.log_scale + step[6:])
            if np.abs(step).max() < 1e-7:
                break
        return guess

    def information(self, guess: _Guess, inlier: BoolArray, cells: int) -> FloatArray:
        """Return the information (6, 6) of the pose from the inliers, of the spread that their residuals have."""
        r, j = self.linearized(guess)
        sigma = max(_MIN_SIGMA_PX, robust_sigma(r[inlier]))
        # One of the two ways: both read the same pixels.
        known = 0.5 * np.einsum("nsra,nsrb->ab", j[inlier], j[inlier]) * min(1.0, cells / inlier.sum())
        hessian = known / sigma**2 + _SCALE_PRIOR
        result: FloatArray = hessian[:6, :6] - hessian[:6, 6:] @ np.linalg.solve(hessian[6:, 6:], hessian[6:, :6])
        return 0.5 * (result + result.T)
