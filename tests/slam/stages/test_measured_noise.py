"""Noise and correlation measured from residuals, against known ones."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.noise import intraclass_correlation
from uni4d_fg.slam.stages.scene import StaticNoise


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9])
def test_correlation_of_groups_is_recovered_despite_outliers(correlation: float, rng: np.random.Generator) -> None:
    group = np.repeat(np.arange(800), rng.integers(2, 30, size=800))
    shared = rng.normal(size=800)[group] * np.sqrt(correlation)
    residuals = 0.02 * (shared + rng.normal(size=len(group)) * np.sqrt(1.0 - correlation))
    residuals[rng.random(len(group)) < 0.01] += 5.0
    assert intraclass_correlation(residuals, group) == pytest.approx(correlation, abs=0.1)


@pytest.mark.parametrize("residuals", [np.zeros(0), np.zeros(5), np.ones(1)], ids=["none", "zero", "one"])
def test_correlation_of_nothing_is_zero(residuals: np.ndarray) -> None:
    assert intraclass_correlation(residuals, np.zeros(len(residuals), dtype=np.int64)) == 0.0


def test_effective_sigma_spends_the_information_of_correlated_depths() -> None:
    independent, alike = StaticNoise(1.0, 0.02, 0.0), StaticNoise(1.0, 0.02, 1.0)
    assert independent.effective_depth_sigma(25.0) == pytest.approx(0.02)
    assert alike.effective_depth_sigma(25.0) == pytest.approx(0.02 * 5.0), "25 equal depths count as one"


def test_robust_sigma_of_a_normal_with_outliers(rng: np.random.Generator) -> None:
    residuals = 0.3 * rng.normal(size=20_000)
    residuals[:400] = 50.0
    assert robust_sigma(residuals) == pytest.approx(0.3, rel=0.05)
    assert np.isnan(robust_sigma(np.zeros(0)))
