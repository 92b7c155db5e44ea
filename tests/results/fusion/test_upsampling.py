"""Depth takes the image's edges when it is brought to the image's size."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.results.fusion.upsampling import upsample_guided


def test_an_edge_lands_on_the_edge_of_the_image_and_a_plane_stays_a_plane(rng: np.random.Generator) -> None:
    height, width = 120, 160
    v, u = np.mgrid[0:height, 0:width]
    near = u + 0.3 * v < 101
    truth = np.where(near, 0.7, 1.2 + 0.001 * u).astype(np.float32)
    image = np.where(near[..., None], (60, 90, 160), (190, 170, 120)) + rng.normal(0, 4, (height, width, 3))
    image = np.clip(image, 0, 255).astype(np.uint8)
    small = cv2.resize(truth, (width // 2, height // 2), interpolation=cv2.INTER_NEAREST)
    beside = np.abs(u + 0.3 * v - 101) < 4
    bilinear = np.abs(cv2.resize(small, (width, height)) - truth)
    guided = np.abs(upsample_guided(small, image) - truth)
    assert guided[beside].mean() < 0.35 * bilinear[beside].mean()
    assert guided[~beside].max() < 0.003


def test_what_is_missing_is_filled_from_beside_and_stays_missing_without() -> None:
    small = np.full((10, 12), 2.0, np.float32)
    small[4, 5] = np.nan
    image = np.zeros((20, 24, 3), np.uint8)
    np.testing.assert_allclose(upsample_guided(small, image), 2.0, rtol=1e-6)
    assert np.isnan(upsample_guided(np.full((10, 12), np.nan, np.float32), image)).all()
