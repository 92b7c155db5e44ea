"""Means over wide windows, against the same windows at full size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.results.fusion.wide_window import blurred


@pytest.mark.parametrize("shape", [(240, 320), (181, 333)])
@pytest.mark.parametrize("sigma", [2.0, 9.0, 30.0])
def test_a_coarse_grid_changes_a_wide_window_by_little(
    rng: np.random.Generator, shape: tuple[int, int], sigma: float
) -> None:
    smooth = cv2.resize(rng.random((6, 8)), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    maps = np.dstack([smooth, rng.random(shape) < 0.5 * smooth]).astype(np.float32)
    expected = cv2.GaussianBlur(maps, (0, 0), sigma)
    found = blurred(maps, sigma)
    assert found.shape == maps.shape
    off, spread = np.abs(found - expected).reshape(-1, 2), expected.reshape(-1, 2).std(axis=0)
    assert (off.mean(axis=0) < 0.04 * spread).all(), off.mean(axis=0) / spread
    np.testing.assert_allclose(blurred(np.ones(shape, np.float32), sigma), 1.0, rtol=1e-5)
