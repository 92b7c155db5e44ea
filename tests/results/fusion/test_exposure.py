"""Relative exposure of frames, against frames whose brightness was changed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.arrays import Float32Array
from uni4d_fg.results.fusion.multiview.exposure import Shown, exposures

HEIGHT, WIDTH = 60, 80
K = np.array([80.0, 80.0, 39.5, 29.5])
ALONG_X = np.eye(4)
ALONG_X[0, 3] = 0.2


def wall(pose: np.ndarray) -> Float32Array:
    """Gray values of the plane Z = 2, seen without rotation."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (2.0 * (pixel - center) / 80.0 for pixel, center in ((u, K[2]), (v, K[3])))
    return (0.45 + 0.2 * np.sin(5 * (x + pose[0, 3])) * np.cos(4 * y)).astype(np.float32)


def points(rng: np.random.Generator, number: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-0.8, 0.8, number), rng.uniform(-0.6, 0.6, number), np.full(number, 2.0)])


@given(factor=st.floats(0.7, 1.3), seed=st.integers(0, 2**16))
def test_factor_is_found_beside_what_moves(factor: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    own, other = wall(np.eye(4)), np.float32(factor) * wall(ALONG_X)
    other[:, :15] = np.nan  # masked
    other[20:30, 30:40] = 0.9  # a highlight that only this frame shows
    found = exposures(Shown(own, np.eye(4), K), [Shown(other, ALONG_X, K), Shown(own, np.eye(4), K)], points(rng, 3000))
    assert found == pytest.approx([1 / factor, 1.0], rel=5e-3)


@pytest.mark.parametrize("case", ["none", "few", "behind", "dark", "masked"])
def test_too_few_points_change_nothing(case: str, rng: np.random.Generator) -> None:
    seen, other = points(rng, {"none": 0, "few": 10}.get(case, 200)), 1.2 * wall(ALONG_X)
    if case == "behind":
        seen[:, 2] = -2.0
    if case == "dark":
        other = 0.01 * other
    if case == "masked":
        other = np.full_like(other, np.nan)
    assert exposures(Shown(wall(np.eye(4)), np.eye(4), K), [Shown(other, ALONG_X, K)], seen) == [1.0]
