"""The nearest points by OpenCV against every distance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.geometry.nearest_points import NearestPoints


@given(st.integers(5, 300), st.integers(0, 40), st.integers(1, 5), st.integers(2, 3), st.integers(0, 10_000))
def test_they_are_those_of_every_distance(points: int, places: int, count: int, dimensions: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud, asked = rng.normal(size=(points, dimensions)), rng.normal(size=(places, dimensions))
    distance, rows = NearestPoints(cloud).find(asked, count)
    every = np.linalg.norm(asked[:, None] - cloud[None], axis=2)
    np.testing.assert_array_equal(rows, np.argsort(every, axis=1)[:, :count])
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, :count], rtol=1e-4, atol=1e-6)


def test_points_that_coincide_are_all_found() -> None:
    cloud = np.repeat([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 200, axis=0)
    distance, rows = NearestPoints(cloud).find(np.array([[0.9, 0.0, 0.0]]), 3)
    np.testing.assert_allclose(distance, 0.1, rtol=1e-5)
    assert (rows >= 200).all()
    assert len(set(rows[0].tolist())) == 3


def test_fewer_points_than_asked_for_are_refused() -> None:
    with pytest.raises(ValueError, match="5 of 4 points"):
        NearestPoints(np.zeros((4, 3))).find(np.zeros((1, 3)), 5)
