"""Covariances of a frame between keyframes: which of two is believed, and how they are chained."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import composed_covariance, se3_exp, se3_log
from uni4d_fg.slam.incremental.pose import larger_covariance, predict, refocused, shared_spread


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


def found_pose(uv: np.ndarray, points: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """Return the twist (6,) of the camera that sees points (n, 3) at pixels (n, 2), by plain least squares."""

    def residual(twist: np.ndarray) -> np.ndarray:
        seen = (points - se3_exp(twist[None])[0, :3, 3]) @ se3_exp(twist[None])[0, :3, :3]
        return np.asarray((focal * seen[:, :2] / seen[:, 2:] - uv).ravel())

    return np.asarray(least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15).x)


def test_a_small_motion_follows_focal_lengths_and_depths(rng: np.random.Generator) -> None:
    """Posed with other focal lengths and depths, the motion is what it is turned into: to second order."""
    uv = rng.uniform(-150.0, 150.0, size=(200, 2))
    z = rng.uniform(2.0, 4.0, size=200)
    old, new, deeper = np.array([315.0, 310.0]), np.array([300.0, 302.0]), 1.08
    before = np.column_stack([uv / old * z[:, None], z])
    pose = se3_exp(np.array([[0.0, 0.0, 3e-3, 0.02, -0.01, 0.015]]))[0]
    seen = (before - pose[:3, 3]) @ pose[:3, :3]
    pixels = old * seen[:, :2] / seen[:, 2:]
    after = np.column_stack([uv / new * deeper * z[:, None], deeper * z])
    expected = se3_exp(found_pose(pixels, after, new)[None])[0]
    followed = refocused(pose, old / new, deeper)
    assert np.abs(followed - expected)[:3, 3].max() < 0.05 * np.abs(pose - expected)[:3, 3].max()
    np.testing.assert_allclose(followed[:3, :3], expected[:3, :3], atol=2e-5)
    np.testing.assert_allclose(refocused(pose, np.ones(2), 1.0), pose, atol=1e-12)


def test_what_all_points_share_spreads_a_small_motion() -> None:
    """The spread of steps is that of refocused ones over focal lengths and depths that are drawn."""
    rng = np.random.default_rng(7)
    pose = se3_exp(np.array([[4e-3, -6e-3, 3e-3, 0.02, -0.01, 0.015]]))[0]
    steps = np.array(
        [
            refocused(pose, np.full(2, np.exp(focal)), np.exp(depth))[:3, 3]
            for focal, depth in rng.normal(size=(20000, 2)) * np.array([0.02, 0.03])
        ]
    )
    spread = shared_spread(pose, 0.02, 0.03)
    np.testing.assert_allclose(np.cov(steps.T), spread[3:, 3:], atol=0.06 * spread[3:, 3:].max())
    np.testing.assert_allclose(np.diag(spread)[:3], (0.02 * np.array([4e-3, 6e-3, 0.0])) ** 2, rtol=1e-6, atol=1e-20)
    np.testing.assert_array_equal(shared_spread(np.eye(4), 0.2, 0.2), np.zeros((6, 6)))
