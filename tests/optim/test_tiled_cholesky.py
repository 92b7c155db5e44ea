"""Large systems are factorized in tiles: against NumPy, and the same for any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.optim import tiled_cholesky
from uni4d_fg.optim.tiled_cholesky import cholesky


def definite(size: int, seed: int = 0) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(size, size))
    return np.asfortranarray(root @ root.T + np.eye(size))


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiled_cholesky, "TILE", 8)
    monkeypatch.setattr(tiled_cholesky, "TILED_SIZE", 9)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize("size", [1, 8, 9, 16, 17, 61])
def test_is_what_numpy_finds(size: int) -> None:
    matrix = definite(size)
    expected = np.linalg.cholesky(matrix)
    matrix[np.triu_indices(size, 1)] = np.nan  # is not read
    factor = cholesky(matrix, 2)
    assert factor is not None
    np.testing.assert_allclose(np.tril(factor), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize(("size", "row"), [(5, 3), (40, 2), (40, 20), (40, 39)])
def test_not_positive_definite(size: int, row: int) -> None:
    matrix = definite(size)
    matrix[row, row] = -1.0
    assert cholesky(matrix, 2) is None


def test_the_same_for_any_number_of_threads() -> None:
    size = tiled_cholesky.TILED_SIZE
    matrix = definite(size)
    factors = [cholesky(matrix.copy(order="F"), threads) for threads in (1, 2, 5)]
    assert factors[0] is not None
    lower = np.tril(factors[0])
    for factor in factors[1:]:
        assert factor is not None
        np.testing.assert_array_equal(np.tril(factor), lower)
    np.testing.assert_allclose(lower @ lower.T, matrix, rtol=0, atol=1e-11 * matrix.max())
