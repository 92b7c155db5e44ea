"""Starting values from depth, and noise measured from residuals."""

from __future__ import annotations

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, observe, static_observations, static_points

from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.lifting import frame_log_scales, lift, mean_per_row
from uni4d_fg.slam.stages.scene import Cameras


def test_lifting_inverts_observing(rng: np.random.Generator) -> None:
    points, poses = static_points(rng, 20), camera_path(4)
    observations = static_observations(observe(points, poses))
    scale = np.array([0.1, -0.2, 0.0, 0.3])
    observations.depth[:] *= np.exp(-scale[observations.frame])
    np.testing.assert_allclose(lift(observations, Cameras(poses, K, scale)), points[observations.track], atol=2e-6)


def test_a_missing_depth_lifts_to_nan_and_nothing_else_does(rng: np.random.Generator) -> None:
    observations = static_observations(observe(static_points(rng, 5), camera_path(3)))
    observations.depth[[1, 7]] = np.nan
    missing = np.isnan(lift(observations, Cameras(camera_path(3), K, np.zeros(3))))
    np.testing.assert_array_equal(np.flatnonzero(missing.any(axis=1)), [1, 7])


def test_mean_per_row_weighs_and_ignores_nan() -> None:
    values = np.array([[0.0, 0, 0], [3, 6, 9], [1, 1, np.nan], [5, 5, 5], [np.nan] * 3])
    row = np.array([0, 0, 0, 1, 2])
    out = mean_per_row(values, np.array([2.0, 1, 100, 7, 1]), row, 4)
    np.testing.assert_allclose(out[:2], [[1, 2, 3], [5, 5, 5]])
    assert np.isnan(out[2:]).all()


def test_a_row_of_weight_zero_has_no_mean() -> None:
    out = mean_per_row(np.ones((2, 3)), np.array([0.0, 1.0]), np.array([0, 1]), 2)
    assert np.isnan(out[0]).all()
    np.testing.assert_array_equal(out[1], 1.0)


def test_frame_log_scales_are_medians_and_zero_without_depth(rng: np.random.Generator) -> None:
    points, poses = static_points(rng, 30), camera_path(4)
    hidden = np.zeros((30, 4), bool)
    hidden[:, 2] = True
    observations = static_observations(hide(observe(points, poses), hidden))
    scale = np.array([0.1, -0.2, 0.7, 0.05])
    observations.depth[:] *= np.exp(-scale[observations.frame])
    observations.depth[::10] *= 3.0
    found = frame_log_scales(observations, poses, points[observations.track], 4)
    np.testing.assert_allclose(found, [0.1, -0.2, 0.0, 0.05], atol=1e-6)


@pytest.mark.parametrize("shape", [(40_000,), (20_000, 2)])
def test_robust_sigma_is_the_sigma_of_a_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> None:
    residuals = rng.normal(scale=0.3, size=shape)
    assert robust_sigma(residuals) == pytest.approx(0.3, rel=0.02)
    residuals[: len(residuals) // 20] = 100.0
    assert robust_sigma(residuals) == pytest.approx(0.3, rel=0.1)


def test_robust_sigma_of_nothing_is_nan_and_of_zeros_is_zero() -> None:
    assert np.isnan(robust_sigma(np.zeros(0)))
    assert robust_sigma(np.zeros(5)) == 0.0
