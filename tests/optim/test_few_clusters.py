"""Blends of a sample covariance and a model: known spreads of displacements, and the mean NEES that follows."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.optim.few_clusters import blend

POSES, DIM = 12, 6


def correlated(rng: np.random.Generator, count: int) -> FloatArray:
    """Covariances (count, 6, 6) with correlations up to 0.99 and scales that differ by a thousand."""
    root = rng.normal(size=(count, DIM, DIM)) * np.geomspace(1.0, 30.0, DIM)
    scale = np.geomspace(1.0, 1e-3, DIM)
    return (root @ np.swapaxes(root, 1, 2)) * scale[:, None] * scale


def mean_nees(
    rng: np.random.Generator, clusters: int, truth: FloatArray, model: FloatArray, draws: int = 60, plain: bool = False
) -> float:
    """Return the mean NEES / 6 of errors with covariances ``truth`` by those that clusters and the model give."""
    root, values = np.linalg.cholesky(truth), []
    for _ in range(draws):
        influence = np.einsum("tij,gtj->gti", root, rng.normal(size=(clusters, POSES, DIM))) / np.sqrt(clusters)
        weights = blend(influence, model, np.zeros_like(model))
        sampled = np.einsum("gti,gtj->tij", influence, influence)
        found = sampled if plain else weights.clusters * sampled + weights.model * model
        error = np.einsum("tij,tj->ti", root, rng.normal(size=(POSES, DIM)))
        values.append(np.einsum("ti,tij,tj->t", error, np.linalg.inv(found), error))
    return float(np.mean(values)) / DIM


@pytest.mark.parametrize("clusters", [12, 20, 60])
@pytest.mark.parametrize("inflation", [1.0, 9.0])
def test_a_model_of_the_right_shape_makes_few_clusters_hold(clusters: int, inflation: float) -> None:
    """NEES of 720 frames, six dimensions each, is known to 2 %; the sample covariance alone is far off."""
    rng = np.random.default_rng(3)
    model = correlated(rng, POSES)
    assert 0.9 < mean_nees(rng, clusters, inflation * model, model) < 1.1
    alone = mean_nees(rng, clusters, inflation * model, model, plain=True)
    assert alone > (1.4 if clusters <= 20 else 1.08)


@pytest.mark.parametrize("clusters", [16, 24, 80])
def test_a_model_of_a_wrong_shape_is_not_believed(clusters: int) -> None:
    """Along some axes errors are nine times as large as along others, by the model's measure."""
    rng = np.random.default_rng(4)
    model = correlated(rng, POSES)
    axes, _ = np.linalg.qr(rng.normal(size=(POSES, DIM, DIM)))
    root = np.linalg.cholesky(model) @ axes
    truth = root * np.array([0.5, 0.5, 1.0, 1.0, 4.5, 4.5]) @ np.swapaxes(root, 1, 2)
    assert 0.75 < mean_nees(rng, clusters, truth, model) < 1.25
    naive = np.mean(np.einsum("tij,tji->t", np.linalg.inv(model), truth)) / DIM
    assert naive == pytest.approx(2.0)


def test_many_clusters_speak_for_themselves() -> None:
    rng = np.random.default_rng(5)
    model, truth = correlated(rng, POSES), correlated(rng, POSES)
    root = np.linalg.cholesky(truth)
    influence = np.einsum("tij,gtj->gti", root, rng.normal(size=(4000, POSES, DIM))) / np.sqrt(4000)
    weights = blend(influence, model, np.zeros_like(model))
    assert weights.share < 0.02
    assert weights.clusters == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(weights.model, weights.share * weights.inflation, rtol=0.02)


def test_what_has_no_clusters_is_not_inflated() -> None:
    """Half of the information is of factors without clusters; the other half errs with four times its variance."""
    rng = np.random.default_rng(6)
    model = correlated(rng, POSES)
    root = np.linalg.cholesky(4.0 * 0.5 * model)
    influence = np.einsum("tij,gtj->gti", root, rng.normal(size=(400, POSES, DIM))) / np.sqrt(400)
    weights = blend(influence, model, 0.5 * model)
    assert weights.inflation == pytest.approx(4.0, rel=0.05)


def test_held_poses_and_undetermined_ones_say_nothing() -> None:
    zero = np.zeros((3, DIM, DIM))
    weights = blend(np.zeros((10, 3, DIM)), zero, zero)
    assert (weights.clusters, weights.model) == (1.0, 0.0)
