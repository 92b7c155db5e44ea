from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.frontend.tracks.depth_sampling import sample_depth


def sample(depth: np.ndarray, *uv: tuple[float, float], low: float = 0.05, high: float = 80.0) -> np.ndarray:
    return sample_depth(np.asarray(depth, np.float32), np.asarray(uv, np.float32), low, high, 0.05)


@given(st.floats(0, 15), st.floats(0, 11))
def test_a_plane_is_interpolated_exactly(u: float, v: float) -> None:
    x, y = np.meshgrid(np.arange(16), np.arange(12))
    value = sample(4 + 0.02 * x - 0.03 * y, (u, v))
    np.testing.assert_allclose(value, [4 + 0.02 * np.float32(u) - 0.03 * np.float32(v)], atol=1e-5)


def test_missing_across_a_discontinuity() -> None:
    depth = np.full((6, 8), 2.0)
    depth[:, 4:] = 3.0
    np.testing.assert_array_equal(
        sample(depth, (2.5, 2.5), (3.1, 2.5), (3.9, 2.5), (4.5, 2.5)),
        np.float32([2.0, np.nan, np.nan, 3.0]),
    )


def test_exactly_on_a_pixel_beside_a_discontinuity() -> None:
    depth = np.full((6, 8), 2.0)
    depth[:, 4:] = 3.0
    # The pixel to the right belongs to the window of four although its weight is zero.
    assert np.isnan(sample(depth, (3.0, 2.0))[0])
    assert sample(depth, (4.0, 2.0))[0] == 3.0


def test_beside_a_hole_the_nearest_pixel_is_taken_if_the_others_agree() -> None:
    depth = np.full((4, 4), 2.0)
    depth[1, 1], depth[1, 2] = 2.02, np.nan
    values = sample(depth, (1.2, 1.2), (1.8, 1.2))
    np.testing.assert_allclose(values[0], 2.02)
    assert np.isnan(values[1])
    depth[2, 1] = 3.0
    assert np.isnan(sample(depth, (1.2, 1.2))[0])


def test_depth_out_of_range_counts_as_missing() -> None:
    depth = np.float32([[0.01, 0.01], [0.01, 0.01]])
    assert np.isnan(sample(depth, (0.5, 0.5))[0])
    assert np.isnan(sample(np.full((2, 2), 100.0), (0.5, 0.5))[0])
    assert np.isnan(sample(np.full((2, 2), np.nan), (0.5, 0.5))[0])
    assert np.isnan(sample(np.full((2, 2), np.inf), (0.5, 0.5))[0])
    assert sample(np.full((2, 2), 80.0), (0.5, 0.5))[0] == 80.0


def test_image_corners_and_the_outer_half_pixel() -> None:
    depth = np.float32([[1.0, 1.01], [1.02, 1.03]])
    np.testing.assert_allclose(
        sample(depth, (0, 0), (1, 1), (-0.5, -0.5), (1.49, 0), (0, 1.49)), [1.0, 1.03, 1.0, 1.01, 1.02]
    )


def test_nothing_to_sample() -> None:
    assert sample_depth(np.ones((3, 3), np.float32), np.zeros((0, 2), np.float32), 0, 9, 0.05).shape == (0,)
