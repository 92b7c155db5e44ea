"""Point errors: exact numbers, masks, missing values."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.geometry.alignment import Similarity
from uni4d_fg.results.evaluate.points import evaluate_points


def test_known_distances() -> None:
    truth = np.zeros((2, 3, 3))
    estimate = truth.copy()
    estimate[0, 0] = [3.0, 4.0, 0.0]
    estimate[1, 2] = [0.0, 0.0, 1.0]
    found = evaluate_points(estimate, truth)
    assert found.rmse_m == pytest.approx(np.sqrt(26 / 6))
    assert found.median_m == 0.0
    assert found.points == 6


def test_alignment_is_applied() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 4, 3))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    similarity = Similarity(turn, np.array([1.0, 2, 3]), 2.0)
    found = evaluate_points(points, similarity.apply(points), None, similarity)
    assert found.rmse_m == pytest.approx(0.0, abs=1e-12)


def test_missing_values_are_counted_and_the_mask_selects() -> None:
    truth = np.zeros((4, 3))
    estimate = np.ones((4, 3))
    estimate[0] = np.nan
    truth[1] = np.nan
    found = evaluate_points(estimate, truth)
    assert (found.points, found.missing_estimates, found.missing_truth) == (2, 1, 1)
    assert found.rmse_m == pytest.approx(np.sqrt(3))
    found = evaluate_points(estimate, truth, np.array([True, True, False, False]))
    assert (found.points, found.rmse_m, found.median_m) == (0, None, None)
    assert (found.missing_estimates, found.missing_truth) == (1, 1)


def test_shapes_that_disagree_are_refused() -> None:
    with pytest.raises(InputError, match="must be equal"):
        evaluate_points(np.zeros((3, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match="mask"):
        evaluate_points(np.zeros((3, 3)), np.zeros((3, 3)), np.ones((2,), bool))
