"""Covariances of a frame between keyframes: which of two is believed, and how they are chained."""

from __future__ import annotations

import numpy as np

from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import composed_covariance, se3_log
from uni4d_fg.slam.incremental.pose import larger_covariance, predict


def covariance_of(rng: np.random.Generator, size: int, scale: float) -> np.ndarray:
    root = rng.normal(size=(size, 2 * size)) * scale
    return root @ root.T / (2 * size)


def test_the_larger_covariance_is_at_least_either_and_no_larger_than_needed(rng: np.random.Generator) -> None:
    for _ in range(5):
        first, second = covariance_of(rng, 6, 1.0), covariance_of(rng, 6, 1.5)
        found = larger_covariance(first, second)
        scale = np.abs(found).max()
        assert np.linalg.eigvalsh(found - first).min() > -1e-9 * scale
        assert np.linalg.eigvalsh(found - second).min() > -1e-9 * scale
        assert np.linalg.eigvalsh(first + second - found).min() > -1e-9 * scale
        np.testing.assert_allclose(larger_covariance(second, first), found, rtol=1e-8, atol=1e-9 * scale)
        np.testing.assert_allclose(larger_covariance(first, 4.0 * first), 4.0 * first)
        np.testing.assert_allclose(larger_covariance(first, 0.25 * first), first)


def test_chained_covariance_is_the_spread_of_chained_poses(rng: np.random.Generator) -> None:
    reference, relative = covariance_of(rng, 6, 0.02), covariance_of(rng, 6, 0.01)
    keyframe_T_cam = se3.se3_exp(np.array([[0.3, -0.2, 0.5, 1.0, -2.0, 0.5]]))[0]
    draws = 20_000
    steps = [rng.multivariate_normal(np.zeros(6), covariance, draws) for covariance in (reference, relative)]
    poses = se3.se3_exp(steps[0]) @ keyframe_T_cam @ se3.se3_exp(steps[1])
    spread = np.cov(se3_log(se3.inverse(keyframe_T_cam) @ poses).T)
    found = composed_covariance(reference, keyframe_T_cam, relative)
    sigma = np.sqrt(np.diag(spread))
    # A correlation from 20,000 draws is known to 0.007; the poses are not quite linear in the steps.
    np.testing.assert_allclose(found / np.outer(sigma, sigma), spread / np.outer(sigma, sigma), atol=0.06)


def test_constant_velocity_is_continued_over_as_many_frames_as_passed() -> None:
    step = se3.se3_exp(np.array([[0.02, -0.05, 0.01, 0.1, 0.02, -0.03]]))[0]
    poses = [np.linalg.matrix_power(step, n) for n in range(7)]
    np.testing.assert_allclose(predict(np.stack(poses[2:4]), np.array([2.0, 3.0]), 4.0), poses[4], atol=1e-12)
    rotation_only = predict(np.stack([poses[0], poses[2]]), np.array([0.0, 2.0]), 4.0)
    np.testing.assert_allclose(rotation_only, poses[4], atol=1e-12)
