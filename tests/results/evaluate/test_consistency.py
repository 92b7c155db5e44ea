"""NEES on linear-Gaussian toys whose answer is known, and the report of a run."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry import se3
from uni4d_fg.results.evaluate.consistency import evaluate_consistency, nees, relative_errors

FRAMES = 2000


def path(rng: np.random.Generator, count: int = FRAMES) -> FloatArray:
    return se3.se3_exp(rng.normal(size=(count, 6)) * np.repeat([0.3, 1.0], 3))


def spreads(rng: np.random.Generator, count: int = FRAMES) -> FloatArray:
    """Full covariances, of rotations of a mrad and positions of a mm, strongly correlated."""
    root = rng.normal(size=(count, 6, 6)) * 1e-3
    return root @ np.swapaxes(root, 1, 2) + 1e-8 * np.eye(6)


def draw(rng: np.random.Generator, truth: FloatArray, covariance: FloatArray) -> FloatArray:
    error = (np.linalg.cholesky(covariance) @ rng.normal(size=(len(truth), 6, 1)))[:, :, 0]
    error[0] = 0.0
    return truth @ se3.se3_exp(error)


def test_errors_drawn_from_the_covariances_have_a_mean_of_one(rng: np.random.Generator) -> None:
    """The mean of 1,999 chi-square values over six deviates by sqrt(2 / (6 x 1999)), 1.3 %."""
    truth, covariance = path(rng), spreads(rng)
    found = evaluate_consistency(draw(rng, truth, covariance), truth, covariance, with_scale=False)
    assert found is not None
    assert found.mean == pytest.approx(1.0, abs=0.05)
    assert found.median == pytest.approx(1.0, abs=0.08)
    assert found.rotation == pytest.approx(1.0, abs=0.07)
    assert found.position == pytest.approx(1.0, abs=0.07)
    assert found.within_95 == pytest.approx(0.95, abs=0.02)
    assert found.within_99 == pytest.approx(0.99, abs=0.01)
    assert found.scale == 1.0
    assert found.frames == FRAMES - 1


def test_covariances_that_are_too_small_show(rng: np.random.Generator) -> None:
    truth, covariance = path(rng), spreads(rng)
    found = evaluate_consistency(draw(rng, truth, covariance), truth, covariance / 4.0, with_scale=False)
    assert found is not None
    assert found.mean == pytest.approx(4.0, rel=0.05)
    assert found.within_95 < 0.3


def test_the_gauge_is_the_first_camera_wherever_the_worlds_lie(rng: np.random.Generator) -> None:
    truth, covariance = path(rng), spreads(rng)
    estimate = draw(rng, truth, covariance)
    moved = se3.se3_exp(np.array([[0.4, -0.3, 1.0, 3.0, -2.0, 5.0]])) @ estimate
    first = evaluate_consistency(estimate, truth, covariance)
    second = evaluate_consistency(moved, truth, covariance)
    assert first is not None
    assert second is not None
    assert second.mean == pytest.approx(first.mean, rel=1e-6)


def test_a_scale_is_no_error_where_it_is_a_gauge(rng: np.random.Generator) -> None:
    truth, covariance = path(rng), spreads(rng)
    truth[0] = np.eye(4)
    estimate = draw(rng, truth, covariance)
    estimate[:, :3, 3] /= 1.25
    covariance[:, :, 3:] /= 1.25  # covariances are those of the estimate's own lengths
    covariance[:, 3:, :] /= 1.25
    metric = evaluate_consistency(estimate, truth, covariance, with_scale=False)
    scaled = evaluate_consistency(estimate, truth, covariance)
    assert metric is not None
    assert scaled is not None
    assert metric.mean > 100.0
    assert scaled.scale == pytest.approx(1.25, abs=1e-3)
    assert scaled.mean == pytest.approx(1.0, abs=0.05)


def test_the_truth_may_err_as_well(rng: np.random.Generator) -> None:
    truth, covariance = path(rng), spreads(rng)
    sigma = (2e-3, 3e-3)
    own = np.tile(np.diag(np.repeat(np.square(sigma), 3)), (FRAMES, 1, 1))
    found = evaluate_consistency(
        draw(rng, truth, covariance + 2.0 * own), truth, covariance, with_scale=False, truth_sigma=sigma
    )
    assert found is not None
    assert found.mean == pytest.approx(1.0, abs=0.05)


def test_errors_are_twists_of_the_estimate_from_the_truth() -> None:
    twist = np.array([[0.0, 0, 0, 0, 0, 0], [1e-3, 2e-3, -1e-3, 4e-3, 0.0, 1e-3]])
    truth = se3.se3_exp(np.array([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0], [0.3, 0.1, 0.2, 2.0, 1.0, 3.0]]))
    np.testing.assert_allclose(relative_errors(truth @ se3.se3_exp(twist), truth), twist, atol=1e-12)
    np.testing.assert_allclose(nees(twist[1:], np.diag(np.arange(1.0, 7.0))[None] * 1e-6), 1.0 + 2 + 1 / 3 + 4 + 1 / 6)


def test_frames_without_a_covariance_do_not_count(rng: np.random.Generator) -> None:
    truth, covariance = path(rng, 5), spreads(rng, 5)
    covariance[2] = np.nan
    covariance[3] = 0.0
    found = evaluate_consistency(draw(rng, truth, np.nan_to_num(covariance) + 1e-9 * np.eye(6)), truth, covariance)
    assert found is not None
    assert found.frames == 2
    assert evaluate_consistency(truth, truth, np.full((5, 6, 6), np.nan)) is None


def test_shapes_that_do_not_fit_are_refused(rng: np.random.Generator) -> None:
    truth = path(rng, 5)
    with pytest.raises(InputError, match="do not fit together"):
        evaluate_consistency(truth, truth[:4], spreads(rng, 5))
    broken = truth.copy()
    broken[2, 0, 0] = np.nan
    with pytest.raises(InputError, match="NaN or infinite"):
        evaluate_consistency(broken, truth, spreads(rng, 5))
