"""Two-view matrices: what a crowd of pairs agrees on, and none where there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.cues.structure.consensus import essential_matrix, fundamental_matrix
from uni4d_fg.geometry import se3


def pairs(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (N, 2) of points in two cameras, a fifth of them wrong, and the true essential matrix."""
    second_T_first = se3.se3_exp(np.array([0.02, -0.05, 0.01, 0.4, 0.1, -0.05]))
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (200, 3))
    there = points @ second_T_first[:3, :3].T + second_T_first[:3, 3]
    first, second = points[:, :2] / points[:, 2:], there[:, :2] / there[:, 2:]
    second[:40] += rng.uniform(-0.3, 0.3, (40, 2))
    essential = se3.skew(second_T_first[:3, 3]) @ second_T_first[:3, :3]
    return first, second, essential / np.linalg.norm(essential)


def test_most_pairs_win(rng: np.random.Generator) -> None:
    first, second, true = pairs(rng)
    found = essential_matrix(first, second, 1e-3, 0.9999, 2000)
    assert found is not None
    matrix, agrees = found
    matrix = matrix / np.linalg.norm(matrix)
    assert min(np.abs(matrix - true).max(), np.abs(matrix + true).max()) < 1e-3
    assert agrees[40:].mean() > 0.95
    assert agrees[:40].mean() < 0.2
    px = fundamental_matrix(500.0 * first, 500.0 * second, 0.5, 0.999, 2000)
    assert px is not None
    a, b = (np.concatenate([500.0 * ray[40:], np.ones((160, 1))], axis=1) for ray in (first, second))
    line = a @ px.T
    assert np.median(np.abs((b * line).sum(axis=1)) / np.linalg.norm(line[:, :2], axis=1)) < 0.1


def test_an_estimator_that_ends_without_a_model_says_none(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    def asserts(*args: object, **kwargs: object) -> None:
        raise cv2.error("(-215:Assertion failed) !model.empty() in function 'setModelParameters'")

    first, second, _ = pairs(rng)
    monkeypatch.setattr(cv2, "findFundamentalMat", asserts)
    monkeypatch.setattr(cv2, "findEssentialMat", asserts)
    assert essential_matrix(first, second, 1e-3, 0.9999, 100) is None
    assert fundamental_matrix(first, second, 1.0, 0.999, 100) is None
