"""How a still scene moves in the image from one frame to a later one, and how far away its points are.

A point at pixel x (about the image's middle, in units of a guessed focal length f) and inverse depth q is found at

    x' = pi(R (x, 1) + q t) + c(x),

R and t being what the camera did, and c a small polynomial of degree two, which takes up what the guess of f, a lens
or a zoom leave. Given what is known of the inverse depths so far, all are fitted together robustly (what moves by
itself covers less than the rest), the inverse depths being eliminated. A new point has the inverse depth of those
around it, at a large uncertainty: it then says something across its epipolar line only, and learns its depth from where
it is found along it. Scale is that of the first points, whose inverse depth is one on average.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, evenly_spread
from uni4d_fg.robust import MEDIAN_OF_NORM

_MOST_FOLLOWED, _ROUNDS, _DEPTH_ROUNDS, _CUT_OFF, _LEAST_SPREAD_PX = 600, 8, 3, 3.0, 0.2
_TURN, _STEP, _POLYNOMIAL_PX = 0.5, 0.5, 0.5
"""Standard deviations: rotation, rad; translation, in units of the mean depth; coefficients of c."""
_CORRELATED = 25.0
"""Errors of the model are alike in neighboring points: as if each point counted as this part of one."""
_DENSITY_OF_MOVING, _LEAST_STILL = 1e-3, 0.02
"""Per square pixel, of where a point goes that moves by itself; no point is surer than this to be at rest, or not."""
_LEAST_DEPTH, _LEAST_INVERSE_DEPTH = 0.1, 1e-3


@dataclass(frozen=True)
class Motion:
    """What the camera did between two frames."""

    image_size: tuple[int, int]
    rotation: FloatArray
    """(3, 3)."""
    translation: FloatArray
    """(3,) in units of the scene's depth."""
    polynomial: FloatArray
    """(5, 2) px, of u, v, u^2, uv, v^2 in units of half the longer side."""
    covariance: FloatArray
    """(16, 16) of rotation, translation and polynomial."""

    @classmethod
    def none(cls, image_size: tuple[int, int]) -> Motion:
        """Return the motion of a camera that stands still."""
        return cls(image_size, np.eye(3), np.zeros(3), np.zeros((5, 2)), np.zeros((16, 16)))

    def move(self, points: FloatArray, inverse_depth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where points (N, 2) px of inverse depths (N,) are: (N, 2) px, and their inverse depths (N,)."""
        y = self._in_front(points, inverse_depth)
        return self._project(y, points), inverse_depth / y[:, 2]

    def by_motion(self, points: FloatArray, inverse_depth: FloatArray) -> FloatArray:
        """Return the derivatives (N, 2, 16) of where points are by rotation, translation and polynomial."""
        y = self._in_front(points, inverse_depth)
        project, turned = self._slope(y), y - inverse_depth[:, None] * self.translation
        result = np.zeros((len(y), 2, 16))
        # The derivative of the cross product with a turn.
        for axis, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
            result[:, :, axis] = project[:, :, b] * turned[:, a, None] - project[:, :, a] * turned[:, b, None]
        result[:, :, 3:6] = project * inverse_depth[:, None, None]
        result[:, 0, 6:11] = result[:, 1, 11:] = _polynomial(points, self.image_size)
        return result

    def by_inverse_depth(self, points: FloatArray, inverse_depth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of where points are (N, 2) and of their new inverse depth (N,) by the old one."""
        y = self._in_front(points, inverse_depth)
        turned = y[:, 2] - inverse_depth * self.translation[2]
        return self._slope(y) @ self.translation, np.abs(turned) / y[:, 2] ** 2

    def _slope(self, y: FloatArray) -> FloatArray:
        """Return the derivatives (N, 2, 3) px of the projection."""
        result = np.zeros((len(y), 2, 3))
        result[:, 0, 0] = result[:, 1, 1] = self._focal / y[:, 2]
        result[:, :, 2] = -self._focal * y[:, :2] / y[:, 2:] ** 2
        return result

    def stepped(self, step: FloatArray, covariance: FloatArray) -> Motion:
        """Return the motion after a step (16,), with a covariance."""
        turn = np.asarray(cv2.Rodrigues(step[:3])[0])
        return Motion(
            self.image_size, turn @ self.rotation, self.translation + step[3:6],
            self.polynomial + step[6:].reshape(2, 5).T, covariance,
        )  # fmt: skip

    @property
    def _focal(self) -> float:
        return float(max(self.image_size))

    def _in_front(self, points: FloatArray, inverse_depth: FloatArray) -> FloatArray:
        middle = 0.5 * (np.array(self.image_size[::-1]) - 1.0)
        ray = np.concatenate(((points - middle) / self._focal, np.ones((len(points), 1))), axis=1)
        y: FloatArray = ray @ self.rotation.T + inverse_depth[:, None] * self.translation
        y[:, 2] = np.maximum(y[:, 2], _LEAST_DEPTH)
        return y

    def _project(self, y: FloatArray, points: FloatArray) -> FloatArray:
        middle = 0.5 * (np.array(self.image_size[::-1]) - 1.0)
        result: FloatArray = self._focal * y[:, :2] / y[:, 2:] + middle
        return result + _polynomial(points, self.image_size) @ self.polynomial


@dataclass(frozen=True)
class Known:
    """What is known of N points in a frame."""

    inverse_depth: FloatArray
    """(N,)."""
    sigma: FloatArray
    """(N,) its standard deviation."""
    still: FloatArray
    """(N,) how likely they are at rest."""

    def picked(self, rows: IntArray) -> Known:
        """Return what is known of some of the points."""
        return Known(self.inverse_depth[rows], self.sigma[rows], self.still[rows])


def fit(start: Motion, source: FloatArray, target: FloatArray, known: Known) -> tuple[Motion, Known]:
    """Fit the motion between two frames.

    Args:
        start: Where to begin.
        source: (N, 2) px of points in the earlier image.
        target: (N, 2) px where they are.
        known: What was known of them in the earlier image.

    Returns:
        The motion, and what is known of the points then, still in the earlier image.
    """
    chosen = evenly_spread(len(source), _MOST_FOLLOWED)
    motion, spread = _fit(start, source[chosen], target[chosen], known.picked(chosen))
    depth = known.inverse_depth.copy()
    for _ in range(_DEPTH_ROUNDS):
        residual, squares, weight = _residuals(motion, source, target, depth, known, spread)
        by_depth = motion.by_inverse_depth(source, depth)[0]
        own = weight * (by_depth**2).sum(axis=1) + known.sigma**-2
        right = weight * (residual * by_depth).sum(axis=1) + (known.inverse_depth - depth) / known.sigma**2
        depth = np.maximum(depth + right / own, _LEAST_INVERSE_DEPTH)
    inside = np.exp(-0.5 * np.minimum(squares, 100.0)) / (2 * np.pi * spread**2)
    still = known.still * inside / (known.still * inside + (1 - known.still) * _DENSITY_OF_MOVING)
    return motion, Known(depth, own**-0.5, np.clip(still, _LEAST_STILL, 1 - _LEAST_STILL))


def _fit(start: Motion, source: FloatArray, target: FloatArray, known: Known) -> tuple[Motion, float]:
    """Return the motion and the standard deviation, px, of points about it; arguments as for :func:`fit`."""
    prior = np.concatenate((np.full(3, _TURN), np.full(3, _STEP), np.full(10, _POLYNOMIAL_PX))) ** -2
    before, sigma, likely = known.inverse_depth, known.sigma, known.still >= min(0.5, float(np.median(known.still)))
    motion, depth = start, before.copy()
    for _ in range(_ROUNDS):
        length = np.linalg.norm(target - motion.move(source, depth)[0], axis=1)
        spread = max(float(np.median(length[likely])) / MEDIAN_OF_NORM, _LEAST_SPREAD_PX)
        residual, _, weight = _residuals(motion, source, target, depth, known, spread)
        by_motion, by_depth = motion.by_motion(source, depth), motion.by_inverse_depth(source, depth)[0]
        weighted = by_motion * weight[:, None, None]
        own = weight * (by_depth**2).sum(axis=1) + sigma**-2
        mixed = np.einsum("nki,nk->ni", weighted, by_depth)
        right = weight * (residual * by_depth).sum(axis=1) + (before - depth) / sigma**2
        information = np.tensordot(weighted, by_motion, axes=((0, 1), (0, 1))) - mixed.T @ (mixed / own[:, None])
        information += np.diag(prior)
        now = np.concatenate((np.zeros(3), motion.translation, motion.polynomial.T.ravel()))
        gradient = np.einsum("nki,nk->i", weighted, residual) - mixed.T @ (right / own) - prior * now
        covariance = np.linalg.inv(information)
        step = covariance @ gradient
        depth = np.maximum(depth + (right - mixed @ step) / own, _LEAST_INVERSE_DEPTH)
        motion = motion.stepped(step, _CORRELATED * covariance)
    return motion, spread


def _residuals(
    motion: Motion, source: FloatArray, target: FloatArray, depth: FloatArray, known: Known, spread: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (N, 2) px, squares (N,) of them and of the change of depth in deviations, weights (N,) px^-2."""
    residual = target - motion.move(source, depth)[0]
    squares = (residual**2).sum(axis=1) / spread**2 + ((depth - known.inverse_depth) / known.sigma) ** 2
    return residual, squares, known.still * (1.0 + squares / _CUT_OFF**2) ** -2 / spread**2


def _polynomial(points: FloatArray, image_size: tuple[int, int]) -> FloatArray:
    """Return u, v, u^2, uv, v^2 (N, 5) in units of half the longer side."""
    height, width = image_size
    u, v = ((points - 0.5 * np.array([width, height])) / (0.5 * max(height, width))).T
    return np.stack([u, v, u * u, u * v, v * v], axis=1)
