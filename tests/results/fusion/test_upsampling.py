"""Depth takes the image's edges when it is brought to the image's size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.upsampling import upsample_guided, upsample_guided_numpy


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


@pytest.mark.parametrize(("height", "width"), [(45, 67), (20, 31)])
def test_cpp_and_numpy_agree(rng: np.random.Generator, height: int, width: int) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    values = rng.normal(1.0, 0.3, (20, 31)).astype(np.float32)
    values[3:9, 4:9] = np.nan
    values[15, 20] = np.inf
    image = rng.integers(90, 130, (height, width, 3)).astype(np.uint8)
    image[:, :9] = 255
    colors = cv2.resize(image.astype(np.float32), (31, 20), interpolation=cv2.INTER_AREA)
    slow = upsample_guided_numpy(values, colors, image, 0.7, 12.0)
    for threads in (1, 3):
        fast = core.upsample_guided(values, colors, image, spatial=0.7, color=12.0, threads=threads)
        np.testing.assert_allclose(fast, slow, rtol=2e-5, atol=1e-6)
    assert np.isnan(slow).any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"values": np.ones((3, 4))}, "values: expected float32"),
        ({"colors": np.ones((3, 4), np.float32)}, "colors: expected float32"),
        ({"image": np.ones((6, 8, 3))}, "image: expected uint8"),
        ({"values": np.ones((0, 4), np.float32), "colors": np.ones((0, 4, 3), np.float32)}, "values: is empty"),
        ({"color": 0.0}, "spatial, color"),
    ],
)
def test_bad_input_is_named(wrong: dict[str, object], message: str) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    given = {
        "values": np.ones((3, 4), np.float32), "colors": np.ones((3, 4, 3), np.float32),
        "image": np.ones((6, 8, 3), np.uint8), "spatial": 0.7, "color": 12.0,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        core.upsample_guided(**(given | wrong))
